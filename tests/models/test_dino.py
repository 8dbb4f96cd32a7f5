"""DINOv2 and DINOv3: entries of their files, a second computation, positions, updates, pyramid."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.engine.optimizers import AdamW
from rgbt.models.dinov2.encoder import (
    Encoder,
    LoraProjection,
    resized_positions,
)
from rgbt.models.dinov2.model import pyramid_level
from rgbt.types import VIEWS
from tests.models import plain
from tests.models.golden import network
from tests.models.plain import cells, count, images, normal, randomise

ROTARY: dict[str, Any] = {
    "position_grid": None,
    "position_resize": None,
    "rope_base": 100.0,
    "key_bias": False,
    "embed_dim": 24,
}


def encoder(**changes: Any) -> Encoder:
    """In the form of DINOv2."""
    sizes = {"patch": 4, "embed_dim": 12, "depth": 3, "num_heads": 3, "mlp_ratio": 4.0}
    positions = {"num_registers": 2, "position_grid": 5, "position_resize": "size"}
    form = {"rope_base": None, "norm_eps": 1e-6, "key_bias": True, "mlp": "gelu"}
    net = Encoder(**{**sizes, **positions, **form, **changes}).eval()
    randomise(net)
    return net


def published_shapes(width: int, registers: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file of S or B."""
    d = width
    shapes: dict[str, tuple[int, ...]] = {
        "cls_token": (1, 1, d),
        "pos_embed": (1, 1 + 37 * 37, d),
        "mask_token": (1, d),
        **({"register_tokens": (1, registers, d)} if registers else {}),
        "patch_embed.proj.weight": (d, 3, 14, 14),
        "patch_embed.proj.bias": (d,),
        "norm.weight": (d,),
        "norm.bias": (d,),
    }
    for block in range(12):
        linear = {"attn.qkv": (3 * d, d), "attn.proj": (d, d), "mlp.fc1": (4 * d, d)}
        for name, (rows, columns) in (linear | {"mlp.fc2": (d, 4 * d)}).items():
            shapes[f"blocks.{block}.{name}.weight"] = (rows, columns)
            shapes[f"blocks.{block}.{name}.bias"] = (rows,)
        vectors = ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias")
        shapes |= {f"blocks.{block}.{n}": (d,) for n in (*vectors, "ls1.gamma", "ls2.gamma")}
    return shapes


def turned(x: Tensor, hw: tuple[int, int], first: int, periods: Tensor) -> Tensor:
    """Queries or keys (T, D) of one head, rotated behind the first tokens, as complex numbers."""
    (h, w), channels = hw, x.shape[1]
    out = x.clone()
    for number in range(h * w):
        centre = (2 * (number // w + 0.5) / h - 1, 2 * (number % w + 0.5) / w - 1)
        for pair in range(channels // 2):
            axis, step = divmod(pair, channels // 4)
            angle = 2 * math.pi * centre[axis] / float(periods[step])
            token = x[first + number]
            value = complex(token[pair], token[pair + channels // 2])
            value *= complex(math.cos(angle), math.sin(angle))
            out[first + number, pair] = value.real
            out[first + number, pair + channels // 2] = value.imag
    return out


def second(
    state: dict[str, Tensor], image: Tensor, depth: int, positions: Tensor | None, eps: float
) -> Tensor:
    """Normalised patch tokens (h w, d) of one image after block `depth`, three heads.

    `positions` (1, 1 + h w, d); None: they are rotary, and keys have no bias.
    """

    def linear(name: str, x: Tensor) -> Tensor:
        return x @ state[f"{name}.weight"].flatten(1).T + state[f"{name}.bias"]

    def normed(name: str, x: Tensor) -> Tensor:
        deviation = (x.var(-1, unbiased=False, keepdim=True) + eps).sqrt()
        x = (x - x.mean(-1, keepdim=True)) / deviation
        return x * state[f"{name}.weight"] + state[f"{name}.bias"]

    patch = state["patch_embed.proj.weight"].shape[-1]
    cut = image.unfold(1, patch, patch).unfold(2, patch, patch)  # 3, h, w, p, p
    hw = cut.shape[1], cut.shape[2]
    x = linear("patch_embed.proj", cut.permute(1, 2, 0, 3, 4).reshape(hw[0] * hw[1], -1))
    x = torch.cat([state["cls_token"][0], x]) + (0 if positions is None else positions[0])
    registers = state.get("register_tokens", torch.zeros(1, 0, x.shape[1]))[0]
    x, first = torch.cat([x[:1], registers, x[1:]]), 1 + len(registers)
    for block in range(depth):
        at = f"blocks.{block}"
        qkv = linear(f"{at}.attn.qkv", normed(f"{at}.norm1", x))
        q, k, v = qkv.chunk(3, 1)
        if positions is None:
            k = k - state[f"{at}.attn.qkv.bias"].chunk(3)[1]
        parts = []
        for head in torch.arange(x.shape[1]).chunk(3):
            query, key = q[:, head], k[:, head]
            if positions is None:
                periods = state["rope_embed.periods"]
                query, key = (turned(part, hw, first, periods) for part in (query, key))
            parts.append((query @ key.T / len(head) ** 0.5).softmax(1) @ v[:, head])
        x = x + state[f"{at}.ls1.gamma"] * linear(f"{at}.attn.proj", torch.cat(parts, 1))
        y = normed(f"{at}.norm2", x)
        if f"{at}.mlp.w1.weight" in state:
            gate = linear(f"{at}.mlp.w1", y)
            gated = gate / (1 + torch.exp(-gate)) * linear(f"{at}.mlp.w2", y)
            y = linear(f"{at}.mlp.w3", gated)
        else:
            hidden = linear(f"{at}.mlp.fc1", y)
            y = linear(f"{at}.mlp.fc2", hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5)))
        x = x + state[f"{at}.ls2.gamma"] * y
    return normed("norm", x)[first:]


@pytest.mark.parametrize(
    ("changes", "hw"),
    [
        ({"num_registers": 0}, (5, 5)),
        ({"norm_eps": 0.1}, (5, 5)),
        ({"position_resize": "factor"}, (3, 7)),
        ({"position_resize": "size"}, (3, 7)),
        *((ROTARY | {"mlp": mlp, "norm_eps": 0.1}, (2, 4)) for mlp in ("gelu", "swiglu")),
    ],
)
@torch.no_grad()
def test_tokens_equal_a_second_computation(changes: dict[str, Any], hw: tuple[int, int]) -> None:
    net, image = encoder(**changes), normal(2, 3, 4 * hw[0], 4 * hw[1])
    positions = None
    if "rope_base" not in changes:
        positions = bicubic(net.pos_embed, *hw, antialiased=net.position_resize == "size")
    for depth, found in zip((2, 3), net(image, layers=(2, 3)), strict=True):
        assert found.shape == (2, net.norm.weight.numel(), *hw)
        for number, own in enumerate(found.flatten(2).transpose(1, 2)):
            eps = changes.get("norm_eps", 1e-6)
            expected = second(net.state_dict(), image[number], depth, positions, eps)
            torch.testing.assert_close(own, expected, rtol=1e-4, atol=1e-5)


def cubic(t: float, a: float) -> float:
    """Keys' cubic kernel; PyTorch has a = -0.75, and -0.5 with antialiasing."""
    t = abs(t)
    if t < 1:
        return (a + 2) * t**3 - (a + 3) * t**2 + 1
    return a * (t**3 - 5 * t**2 + 8 * t - 4) if t < 2 else 0.0


def axis(size: int, grid: int, *, antialiased: bool) -> Tensor:
    """(size, grid): how much each old position counts for a new one."""
    if size == grid:
        return torch.eye(size)
    weights = torch.zeros(size, grid)
    # The published files without registers: a factor of (size + 0.1) / grid.
    step = grid / size if antialiased else grid / (size + 0.1)
    for new in range(size):
        centre = (new + 0.5) * step
        if antialiased:
            width = max(step, 1.0)
            old = torch.arange(grid)
            row = torch.tensor([cubic((float(o) + 0.5 - centre) / width, -0.5) for o in old])
            weights[new] = row / row.sum()
            continue
        first = int(torch.floor(torch.tensor(centre - 0.5)))
        for old in range(first - 1, first + 3):
            weights[new, min(max(old, 0), grid - 1)] += cubic(centre - 0.5 - old, -0.75)
    return weights


def bicubic(positions: Tensor, h: int, w: int, *, antialiased: bool) -> Tensor:
    grid = positions[0, 1:].unflatten(0, (5, 5))
    rows, columns = (axis(side, 5, antialiased=antialiased) for side in (h, w))
    patches = torch.einsum("yo,xp,opd->yxd", rows, columns, grid)
    return torch.cat([positions[:, :1], patches.flatten(0, 1)[None]], 1)


@pytest.mark.parametrize("hw", [(3, 7), (8, 10)])
@pytest.mark.parametrize("form", ["factor", "size"])
def test_positions_are_resized_in_both_published_forms(hw: tuple[int, int], form: Any) -> None:
    positions = normal(1, 26, 4)
    assert resized_positions(positions, (5, 5), form) is positions
    found = resized_positions(positions, hw, form)
    expected = bicubic(positions, *hw, antialiased=form == "size")
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_hidden_patches_show_mask_token_and_do_not_count() -> None:
    net = encoder()
    hidden = torch.zeros(1, 5, 5, dtype=torch.bool)
    hidden[0, 1, 3] = True
    first = normal(1, 3, 20, 20)
    other = first.clone()
    other[..., 4:8, 12:16] = 5.0
    assert torch.equal(net(first, hidden, layers=(3,))[0], net(other, hidden, layers=(3,))[0])
    plain = net(first, hidden, layers=(3,))[0]
    net.mask_token.add_(1.0)
    assert not torch.equal(net(first, hidden, layers=(3,))[0], plain)
    assert torch.equal(net(first, layers=(3,))[0], net(first, hidden & False, layers=(3,))[0])


@pytest.mark.parametrize("parts", [("q", "v"), ("q", "k", "v"), ("k",)])
@torch.no_grad()
def test_updates_equal_a_changed_projection(parts: Any) -> None:
    """W + alpha / rank B A in the rows of q, k or v; the same bits while B is 0."""
    net, image = encoder(), normal(1, 3, 20, 20)
    lora = nn.ModuleList(LoraProjection(12, rank=2, alpha=3.0, parts=parts) for _ in range(3))
    assert torch.equal(net(image, layers=(3,), lora=lora)[0], net(image, layers=(3,))[0])
    for number, update in enumerate(lora):
        for part in parts:
            update.up[part].copy_(normal(12, 2, seed=number))
            start = 12 * "qkv".index(part)
            change = 3.0 / 2 * update.up[part] @ update.down[part]
            net.blocks[number].attn.qkv.weight[start : start + 12] += change
    expected = net(image, layers=(3,))[0]
    net.load_state_dict(encoder().state_dict())
    found = net(image, layers=(3,), lora=lora)[0]
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)


def published_dinov3(width: int, *, gated: bool = False) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file of S, S+ or B."""
    d = width
    shapes = published_shapes(width, registers=0)
    del shapes["pos_embed"]
    shapes |= {"storage_tokens": (1, 4, d), "rope_embed.periods": (16,)}
    shapes["patch_embed.proj.weight"] = (d, 3, 16, 16)
    for block in range(12):
        at = f"blocks.{block}"
        shapes[f"{at}.attn.qkv.bias_mask"] = (3 * d,)
        if gated:
            first, second = (shapes.pop(f"{at}.mlp.fc{n}.weight") for n in (1, 2))
            for name, shape in (("w1", first), ("w2", first), ("w3", second)):
                shapes[f"{at}.mlp.{name}.weight"] = shape
                shapes[f"{at}.mlp.{name}.bias"] = shape[:1]
            del shapes[f"{at}.mlp.fc1.bias"], shapes[f"{at}.mlp.fc2.bias"]
    return shapes


@pytest.mark.parametrize(
    ("yaml", "shapes", "values"),
    [
        ("dinov2_vits14", published_shapes(384, 0), 22_056_576),
        ("dinov2_vits14_reg", published_shapes(384, 4), 22_058_112),
        ("dinov2_vitb14", published_shapes(768, 0), 86_580_480),
        ("dinov2_vitb14_reg", published_shapes(768, 4), 86_583_552),
        ("dinov3_vits16", published_dinov3(384), 21_601_152),
        ("dinov3_vits16plus", published_dinov3(384, gated=True), 28_697_472),
        ("dinov3_vitb16", published_dinov3(768), 85_669_632),
    ],
)
def test_the_encoder_has_the_entries_of_the_published_file(
    yaml: str, shapes: dict[str, tuple[int, ...]], values: int
) -> None:
    with torch.device("meta"):
        net = network(yaml).backbone.encoder
    state = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    if "dinov3" in yaml:
        state["storage_tokens"] = state.pop("register_tokens")
    assert state == {n: s for n, s in shapes.items() if not n.endswith("bias_mask")}
    assert count(net) == values


@torch.no_grad()
def test_the_bias_of_the_keys_does_not_count() -> None:
    net, image = encoder(**ROTARY), normal(1, 3, 8, 16)
    before = net(image, layers=(3,))[0]
    query, key, value = net.blocks[0].attn.qkv.bias.chunk(3)
    key.add_(1.0)
    assert torch.equal(net(image, layers=(3,))[0], before)
    for part in (query, value):
        part.add_(1.0)
        after = net(image, layers=(3,))[0]
        assert not torch.equal(after, before)
        before = after


# ---- the network ----
nano = partial(plain.nano, "dinov2")
ADAMW = AdamW(
    lr=1.0,
    backbone_multiplier=0.1,
    weight_decay=0.05,
    decay_biases=True,
    betas=(0.9, 0.999),
    eps=1e-8,
)


@pytest.mark.parametrize(
    ("patch", "token_px", "hw"), [(4, 8, (32, 48)), (14, 16, (56, 84)), (8, 8, (64, 96))]
)
def test_a_patch_covers_token_px_pixels(patch: int, token_px: int, hw: tuple[int, int]) -> None:
    net, seen = nano(patch=patch, token_px=token_px).eval(), []
    net.backbone.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    pair = images(1)
    net(*pair)
    for image, found in zip(pair, seen, strict=True):
        assert found.shape == (1, 3, *hw)
        if patch == token_px:  # nothing is resized
            torch.testing.assert_close(found, (2 * image - 1).expand(-1, 3, -1, -1))


@torch.no_grad()
def test_levels_equal_a_second_computation() -> None:
    x = normal(1, 4, 2, 3)
    finer = pyramid_level(4, token_px=8, stride=4)
    weight, bias = finer[0].weight, finer[0].bias  # (in, out, 2, 2), without overlap
    expected = torch.zeros(1, 2, 4, 6)
    for row in range(4):
        for column in range(6):
            pixel = x[0, :, row // 2, column // 2] @ weight[:, :, row % 2, column % 2] + bias
            expected[0, :, row, column] = F.layer_norm(pixel, (2,))
    torch.testing.assert_close(finer(x), expected)
    coarser = pyramid_level(4, token_px=8, stride=16)
    highest = x[..., :2, :2].amax((2, 3))
    torch.testing.assert_close(coarser(x[..., :2, :2])[..., 0, 0], F.layer_norm(highest, (4,)))


@pytest.mark.parametrize("tuning", ["frozen", "lora"])
def test_the_encoder_is_not_trained(tuning: str) -> None:
    net = nano(tuning=tuning).train()
    before = {name: value.clone() for name, value in net.backbone.encoder.state_dict().items()}
    optimizer = ADAMW(net)
    listed = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert listed == {id(p) for p in net.parameters() if p.requires_grad}
    aux = net(*images(4), cells(4), passes=2, views=VIEWS).aux
    sum((x * normal(*x.shape, seed=2)).sum() for x in aux.values()).backward()
    optimizer.step()
    assert all(p.grad is None for p in net.backbone.encoder.parameters())
    after = net.backbone.encoder.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert bool(len(net.backbone.lora)) == (tuning == "lora")


@pytest.mark.parametrize("per_modality", [True, False])
@torch.no_grad()
def test_updates_change_nothing_at_first_and_then_their_modality(per_modality: bool) -> None:
    frozen = nano(tuning="frozen").eval()
    net = nano(tuning="lora", lora_per_modality=per_modality).eval()
    assert set(net.backbone.lora) == ({"rgb", "thermal"} if per_modality else {"both"})
    own = {k: v for k, v in net.state_dict().items() if k.startswith("backbone.lora.")}
    net.load_state_dict({**frozen.state_dict(), **own})
    pair, masks = images(2), cells(2)

    def logits(of: nn.Module) -> list[torch.Tensor]:
        return [of(*pair, masks, views=(view,)).logits for view in ("rgb", "thermal")]

    before = logits(net)
    assert all(torch.equal(a, b) for a, b in zip(before, logits(frozen), strict=True))
    net.backbone.lora["thermal" if per_modality else "both"][0].up["v"].copy_(normal(8, 2))
    same = [torch.equal(a, b) for a, b in zip(before, logits(net), strict=True)]
    assert same == [per_modality, False]


@torch.no_grad()
def test_thermal_vector_starts_at_0_and_reaches_thermal_alone() -> None:
    net, pair = nano().eval(), images(1)
    assert not net.backbone.thermal_embedding.any()
    before = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    net.backbone.thermal_embedding.add_(torch.arange(8.0))
    after = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    assert [torch.equal(a, b) for a, b in zip(before, after, strict=True)] == [True, False]


@pytest.mark.parametrize("off", ["thermal_embedding", "lora_per_modality", "pixel_decoder_fp32"])
def test_switches_of_equal_defaults_are_read_for_themselves(off: str) -> None:
    switches = {"thermal_embedding": True, "lora_per_modality": True, "pixel_decoder_fp32": True}
    net = nano(tuning="lora", **(switches | {off: False}))
    assert (net.backbone.thermal_embedding is None) == (off == "thermal_embedding")
    assert (set(net.backbone.lora) == {"both"}) == (off == "lora_per_modality")
    assert (not net.sem_seg_head.pixel_decoder.fp32) == (off == "pixel_decoder_fp32")
