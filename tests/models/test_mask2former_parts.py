"""Parts of Mask2Former against loops and against torch's own modules."""

from __future__ import annotations

import math

import pytest
import torch
from torch import nn
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
    relative_index,
    shift_mask,
)
from tests.models.plain import normal, randomise

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
