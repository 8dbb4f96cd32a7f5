"""The vision transformer of DINOv3: names and sizes of its files, and a second computation."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.models.dinov2.encoder import Encoder
from rgbt.models.dinov2.encoder import RotaryPositions, rotated
from tests.models import test_dinov2_encoder as dinov2
from tests.models.golden import network
from tests.models.plain import count, normal

FORM: dict[str, Any] = {
    **{"position_grid": None, "position_resize": None, "rope_base": 100.0, "norm_eps": 1e-5},
    **{"key_bias": False, "embed_dim": 24},
}
encoder = partial(dinov2.encoder, **FORM)


def published_shapes(width: int, *, gated: bool = False) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file of S, S+ or B."""
    d = width
    shapes: dict[str, tuple[int, ...]] = {
        **{"cls_token": (1, 1, d), "storage_tokens": (1, 4, d), "mask_token": (1, d)},
        **{"patch_embed.proj.weight": (d, 3, 16, 16), "patch_embed.proj.bias": (d,)},
        **{"rope_embed.periods": (16,), "norm.weight": (d,), "norm.bias": (d,)},
    }
    mlp = {"fc1": (4 * d, d), "fc2": (d, 4 * d)}
    if gated:
        mlp = {"w1": (4 * d, d), "w2": (4 * d, d), "w3": (d, 4 * d)}
    for block in range(12):
        linear = {"attn.qkv": (3 * d, d), "attn.proj": (d, d)}
        for name, shape in (linear | {f"mlp.{name}": shape for name, shape in mlp.items()}).items():
            shapes[f"blocks.{block}.{name}.weight"] = shape
            shapes[f"blocks.{block}.{name}.bias"] = shape[:1]
        shapes[f"blocks.{block}.attn.qkv.bias_mask"] = (3 * d,)
        vectors = ("norm1.weight", "norm1.bias", "norm2.weight", "norm2.bias")
        shapes |= {f"blocks.{block}.{n}": (d,) for n in (*vectors, "ls1.gamma", "ls2.gamma")}
    return shapes


@pytest.mark.parametrize(
    ("yaml", "width", "gated", "values"),
    [
        ("dinov3_vits16", 384, False, 21_601_152),
        ("dinov3_vits16plus", 384, True, 28_697_472),
        ("dinov3_vitb16", 768, False, 85_669_632),
    ],
)
def test_the_encoder_has_the_entries_of_the_published_file(
    yaml: str, width: int, gated: bool, values: int
) -> None:
    with torch.device("meta"):
        net = network(yaml).backbone.encoder
    state = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    state["storage_tokens"] = state.pop("register_tokens")
    published = published_shapes(width, gated=gated)
    assert state == {n: s for n, s in published.items() if not n.endswith("bias_mask")}
    assert count(net) == values


# ---- a second computation from the state dict, with pairs of channels as complex numbers ---------


def turned(x: Tensor, hw: tuple[int, int], first: int, periods: Tensor) -> Tensor:
    """Queries or keys (T, D) of one head, rotated behind the first tokens."""
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


def second(state: dict[str, Tensor], image: Tensor, depth: int, heads: int) -> Tensor:
    """Normalised patch tokens (h w, d) of one image after block `depth`."""
    patch, width = state["patch_embed.proj.weight"].shape[-1], state["cls_token"].shape[-1]
    cut = image.unfold(1, patch, patch).unfold(2, patch, patch)  # 3, h, w, p, p
    hw = cut.shape[1], cut.shape[2]
    x = cut.permute(1, 2, 0, 3, 4).reshape(hw[0] * hw[1], -1)
    x = x @ state["patch_embed.proj.weight"].flatten(1).T + state["patch_embed.proj.bias"]
    x = torch.cat([state["cls_token"][0], state["register_tokens"][0], x])
    first, periods = len(x) - hw[0] * hw[1], state["rope_embed.periods"]
    for block in range(depth):
        start = f"blocks.{block}."
        own = {n.removeprefix(start): v for n, v in state.items() if n.startswith(start)}
        y = normed(x, own["norm1.weight"], own["norm1.bias"])
        weights, biases = own["attn.qkv.weight"].chunk(3), own["attn.qkv.bias"].chunk(3)
        q, k, v = y @ weights[0].T + biases[0], y @ weights[1].T, y @ weights[2].T + biases[2]
        parts = []
        for head in torch.arange(width).chunk(heads):
            query, key = (turned(each[:, head], hw, first, periods) for each in (q, k))
            parts.append((query @ key.T / len(head) ** 0.5).softmax(1) @ v[:, head])
        y = torch.cat(parts, 1) @ own["attn.proj.weight"].T + own["attn.proj.bias"]
        x = x + own["ls1.gamma"] * y
        y = normed(x, own["norm2.weight"], own["norm2.bias"])
        x = x + own["ls2.gamma"] * feed_forward(own, y)
    return normed(x, state["norm.weight"], state["norm.bias"])[first:]


def feed_forward(own: dict[str, Tensor], y: Tensor) -> Tensor:
    def linear(name: str, x: Tensor) -> Tensor:
        return x @ own[f"mlp.{name}.weight"].T + own[f"mlp.{name}.bias"]

    if "mlp.w1.weight" in own:
        gate = linear("w1", y)
        return linear("w3", gate / (1 + torch.exp(-gate)) * linear("w2", y))
    hidden = linear("fc1", y)
    return linear("fc2", hidden * 0.5 * (1 + torch.erf(hidden / 2**0.5)))


def normed(x: Tensor, weight: Tensor, bias: Tensor) -> Tensor:
    variance = x.var(-1, unbiased=False, keepdim=True)
    return (x - x.mean(-1, keepdim=True)) / (variance + 0.1).sqrt() * weight + bias


@pytest.mark.parametrize("mlp", ["gelu", "swiglu"])
@torch.no_grad()
def test_tokens_equal_a_second_computation(mlp: str) -> None:
    net, image = encoder(mlp=mlp, norm_eps=0.1), normal(1, 3, 8, 16)
    maps = net(image, layers=(2, 3))
    for depth, found in zip((2, 3), maps, strict=True):
        expected = second(net.state_dict(), image[0], depth, heads=3)
        assert found.shape == (1, 24, 2, 4)
        torch.testing.assert_close(found[0].flatten(1).T, expected, rtol=1e-4, atol=1e-5)


@torch.no_grad()
def test_the_bias_of_the_keys_does_not_count() -> None:
    net, image = encoder(), normal(1, 3, 8, 16)
    before = net(image, layers=(3,))[0]
    query, key, value = net.blocks[0].attn.qkv.bias.chunk(3)
    key.add_(1.0)
    assert torch.equal(net(image, layers=(3,))[0], before)
    for part in (query, value):
        part.add_(1.0)
        after = net(image, layers=(3,))[0]
        assert not torch.equal(after, before)
        before = after


def test_rotation_by_hand() -> None:
    """Three rows and one column: rows at -2/3, 0 and 2/3, the column at 0; periods 1 and 10."""
    positions = RotaryPositions(8, 100.0)
    torch.testing.assert_close(positions.periods, torch.tensor([1.0, 10.0]))
    cos, sin = positions((3, 1), 1)
    assert cos.shape == sin.shape == (4, 8)
    full, tenth = 2 * math.pi * 2 / 3, 2 * math.pi * 2 / 30
    angles = torch.tensor([[0.0, 0.0], [-full, -tenth], [0.0, 0.0], [full, tenth]])
    angles = torch.cat([angles, torch.zeros(4, 2)], 1).tile(2)
    torch.testing.assert_close(cos, angles.cos())
    torch.testing.assert_close(sin, angles.sin())


def test_half_precision_is_rounded_after_the_rotation() -> None:
    x = normal(1, 1, 4, 8).bfloat16()
    rotation = RotaryPositions(8, 100.0)((3, 1), 1)
    assert torch.equal(rotated(x, rotation), rotated(x.float(), rotation).bfloat16())


def test_initial_tokens_are_drawn_as_in_the_release() -> None:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        net = network("dinov3_tiny").backbone.encoder
    tokens = torch.cat([net.cls_token.detach(), net.register_tokens.detach()], 1)
    assert float(tokens.std()) == pytest.approx(0.02, rel=0.15)
    assert not net.mask_token.any()


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"rope_base": None}, "positions are either learned"),
        ({"position_grid": 5}, "positions are either learned"),
        ({"position_resize": "size"}, "positions are either learned"),
        ({"embed_dim": 18}, r"model\.embed_dim = 18 must be a multiple of 4 channels"),
    ],
)
def test_positions_that_do_not_fit_name_the_keys(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        dinov2.encoder(**{**FORM, **changes})


def test_the_tiny_network_is_of_the_form() -> None:
    with torch.device("meta"):
        net = network("dinov3_tiny")
    assert isinstance(net.backbone.encoder, Encoder)
    assert count(net) < 1e6
