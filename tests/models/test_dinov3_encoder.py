"""The vision transformer of DINOv3: names and sizes of its files, rotary positions, its bias."""

from __future__ import annotations

import math

import pytest
import torch

from rgbt.models.dinov2.encoder import RotaryPositions, rotated
from tests.models import test_dinov2_encoder as dinov2
from tests.models.golden import network
from tests.models.plain import count, normal


def published_shapes(width: int, *, gated: bool = False) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a published file of S, S+ or B."""
    d = width
    shapes = dinov2.published_shapes(width, registers=0)
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


@torch.no_grad()
def test_the_bias_of_the_keys_does_not_count() -> None:
    net, image = dinov2.encoder(**dinov2.ROTARY), normal(1, 3, 8, 16)
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
    full, tenth = 2 * math.pi * 2 / 3, 2 * math.pi * 2 / 30
    angles = torch.tensor([[0.0, 0.0], [-full, -tenth], [0.0, 0.0], [full, tenth]])
    angles = torch.cat([angles, torch.zeros(4, 2)], 1).tile(2)
    torch.testing.assert_close(cos, angles.cos())
    torch.testing.assert_close(sin, angles.sin())


def test_half_precision_is_rounded_after_the_rotation() -> None:
    x = normal(1, 1, 4, 8).bfloat16()
    rotation = RotaryPositions(8, 100.0)((3, 1), 1)
    assert torch.equal(rotated(x, rotation), rotated(x.float(), rotation).bfloat16())
