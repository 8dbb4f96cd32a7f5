"""Parts of Mask2Former against loops and against torch's own modules."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.models.mask2former.decoder import QueryAttention
from rgbt.models.mask2former.pixel_decoder import (
    DeformableAttention,
    centre_grid,
    shrink,
    sine_code,
)
from rgbt.models.mask2former.swin import (
    PatchMerging,
    WindowAttention,
    relative_index,
    shift_mask,
)
from tests.models.plain import nano, normal, randomise

CPU = torch.device("cpu")


def test_relative_index_by_hand() -> None:
    # Tokens (0,0) (0,1) (1,0) (1,1); (dy + 1) * 3 + (dx + 1).
    expected = [[4, 3, 1, 0], [5, 4, 2, 1], [7, 6, 4, 3], [8, 7, 5, 4]]
    assert relative_index(2).tolist() == expected


def test_shift_mask_by_hand() -> None:
    """4 x 4 tokens, windows of 2, rolled by 1: the last row and column came from the front."""
    mask = shift_mask((4, 4), 2, 1, CPU)
    assert mask.shape == (4, 1, 4, 4)
    blocked = mask[:, 0] < 0
    assert not blocked[0].any()
    columns_apart = torch.tensor([[0, 1, 0, 1], [1, 0, 1, 0], [0, 1, 0, 1], [1, 0, 1, 0]]).bool()
    rows_apart = torch.tensor([[0, 0, 1, 1], [0, 0, 1, 1], [1, 1, 0, 0], [1, 1, 0, 0]]).bool()
    assert torch.equal(blocked[1], columns_apart)
    assert torch.equal(blocked[2], rows_apart)
    assert torch.equal(blocked[3], columns_apart | rows_apart)


@pytest.mark.parametrize("shift", [0, 1])
@torch.no_grad()
def test_block_attention_equals_a_loop_over_tokens(shift: int) -> None:
    """5 x 7 tokens padded to 6 x 9, windows of 3; padding is attended to, as released."""
    attn = WindowAttention(8, 2, 3, shift)
    randomise(attn)
    x = normal(1, 5, 7, 8, seed=9)
    expected = torch.zeros(5, 7, 8)
    q, k, v = attn.qkv(F.pad(x[0], (0, 0, 0, 2, 0, 1))).chunk(3, -1)
    table = attn.relative_position_bias_table.view(5, 5, 2)
    for r in range(5):
        for c in range(7):
            peers = [
                (y, z)
                for y in range(6)
                for z in range(9)
                if _window(y, shift) == _window(r, shift) and _window(z, shift) == _window(c, shift)
            ]
            heads = []
            for h in range(2):
                part = slice(4 * h, 4 * h + 4)
                scores = [
                    q[r, c, part] @ k[y, z, part] / 2 + table[r - y + 2, c - z + 2, h]
                    for y, z in peers
                ]
                values = torch.stack([v[y, z, part] for y, z in peers])
                heads.append(torch.stack(scores).softmax(0) @ values)
            expected[r, c] = attn.proj(torch.cat(heads))
    torch.testing.assert_close(attn(x)[0], expected, rtol=1e-4, atol=1e-5)


def _window(position: int, shift: int) -> int:
    """Number of the window; the first `shift` tokens wrap around into a group of their own."""
    return -1 if position < shift else (position - shift) // 3


def test_patch_merging_order() -> None:
    """Four neighbours in the order (0,0) (1,0) (0,1) (1,1); an odd side is padded with zeros."""
    merge = PatchMerging(1)
    merge.norm = nn.Identity()
    merge.reduction = nn.Identity()
    x = torch.tensor([[1.0, 2, 3], [4, 5, 6]]).view(1, 2, 3, 1)
    assert merge(x).view(2, 4).tolist() == [[1, 4, 2, 5], [3, 6, 0, 0]]


def test_sine_code_equals_its_formula() -> None:
    code = sine_code((2, 3), 8, CPU).view(2, 3, 8)
    for y in range(2):
        for x in range(3):
            expected = []
            for position, size in ((y, 2), (x, 3)):
                angle = 2 * math.pi * (position + 1) / (size + 1e-6)
                for slower in (angle, angle / 10000 ** (2 / 4)):
                    expected += [math.sin(slower), math.cos(slower)]
            torch.testing.assert_close(code[y, x], torch.tensor(expected), rtol=1e-5, atol=1e-5)


def test_centre_grid_by_hand() -> None:
    centre, scale = centre_grid(((1, 2),), CPU)
    assert centre.tolist() == [[-0.5, 0.5], [0.0, 0.0]]
    assert scale.flatten().tolist() == [1.0, 2.0]


@torch.no_grad()
def test_deformable_attention_equals_a_loop_over_samples() -> None:
    levels = ((2, 3), (4, 5))
    layer = DeformableAttention(8, heads=2, num_levels=2)
    randomise(layer)
    query, tokens = normal(2, 26, 8, seed=50), normal(2, 26, 8, seed=51)
    value = layer.value_proj(tokens).view(2, 26, 2, 4)
    offsets = layer.sampling_offsets(query).view(2, 26, 2, 2, 4, 2)
    weights = layer.attention_weights(query).view(2, 26, 2, 8).softmax(-1).view(2, 26, 2, 2, 4)
    out = torch.zeros(2, 26, 2, 4)
    centres = [
        ((r + 0.5) / h, (c + 0.5) / w) for h, w in levels for r in range(h) for c in range(w)
    ]
    indices = torch.cartesian_prod(*(torch.arange(n) for n in (2, 26, 2, 2, 4)))
    for b, s, m, e, j in indices.tolist():
        (h, w), start = levels[e], (0, 6)[e]
        dx, dy = offsets[b, s, m, e, j].tolist()
        row, column = centres[s][0] * h + dy - 0.5, centres[s][1] * w + dx - 0.5
        grid = value[b, start : start + h * w, m].view(h, w, 4)
        out[b, s, m] += weights[b, s, m, e, j] * _bilinear(grid, row, column)
    expected = layer.output_proj(out.flatten(2))
    torch.testing.assert_close(layer(query, tokens, levels), expected, rtol=1e-4, atol=1e-5)


def _bilinear(grid: Tensor, row: float, column: float) -> Tensor:
    """Bilinear sample at a position in pixels; zero outside."""
    total = torch.zeros(grid.shape[-1])
    top, left = math.floor(row), math.floor(column)
    for r in (top, top + 1):
        for c in (left, left + 1):
            if 0 <= r < grid.shape[0] and 0 <= c < grid.shape[1]:
                total += (1 - abs(row - r)) * (1 - abs(column - c)) * grid[r, c]
    return total


def test_deformable_attention_starts_by_looking_around() -> None:
    """Four heads look right, down, left, up, at 1..4 pixels."""
    layer = DeformableAttention(8, heads=4, num_levels=1)
    bias = layer.sampling_offsets.bias.view(4, 4, 2)
    for head, direction in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1)]):
        for point in range(4):
            expected = torch.tensor(direction) * (point + 1.0)
            torch.testing.assert_close(bias[head, point], expected, rtol=0, atol=1e-6)
    assert not layer.sampling_offsets.weight.any()


def test_attention_equals_torch_module() -> None:
    ours, theirs = QueryAttention(8, 2), nn.MultiheadAttention(8, 2, batch_first=True)
    theirs.load_state_dict(randomise(ours))
    query, key, value = normal(2, 3, 8, seed=1), normal(2, 5, 8, seed=2), normal(2, 5, 8, seed=3)
    allowed = normal(2, 3, 5, seed=4) < 0.3
    allowed |= ~allowed.any(-1, keepdim=True)
    blocked = ~allowed.repeat_interleave(2, dim=0)
    found = ours(query, key, value, allowed)
    torch.testing.assert_close(found, theirs(query, key, value, attn_mask=blocked)[0])
    torch.testing.assert_close(ours(query, key, value, None), theirs(query, key, value)[0])
    with torch.autocast("cpu", torch.bfloat16):
        rounded = ours(query, key, value, allowed)
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), found, rtol=0.05, atol=0.05)


@pytest.mark.parametrize("factor", [2, 4, 8])
def test_shrink_equals_bilinear_interpolation(factor: int) -> None:
    x, size = normal(2, 3, 16, 24), (16 // factor, 24 // factor)
    expected = F.interpolate(x, size=size, mode="bilinear", align_corners=False)
    torch.testing.assert_close(shrink(x, factor), expected)


def test_head_without_masks_of_some_samples_has_the_same_gradients() -> None:
    """In double precision: what differs in single precision is the order of the sums."""
    head = nano("mask2former").sem_seg_head.double()
    head.pixel_decoder.fp32 = False
    widths, sides = (8, 16, 32, 64), ((16, 24), (8, 12), (4, 6), (2, 3))
    sizes = [(5, width, *side) for width, side in zip(widths, sides, strict=True)]
    found = []
    for num_masks in (None, 3):
        features = [normal(*size, seed=i).double() for i, size in enumerate(sizes)]
        leaves = [each.requires_grad_() for each in features]
        classes, masks = head.predictor(head.pixel_decoder(leaves, num_masks))
        assert masks.shape[1] == (num_masks or 5)
        loss = classes.square().sum() + masks[:, :3].square().sum()
        wanted = [*leaves, *head.parameters()]
        found.append([classes, masks[:, :3], *torch.autograd.grad(loss, wanted)])
    for every, fewer in zip(*found, strict=True):
        torch.testing.assert_close(fewer, every, rtol=1e-10, atol=1e-10)
