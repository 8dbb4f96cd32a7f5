"""The network with DINO's encoder: resizing, pyramid, what is trained, updates."""

from __future__ import annotations

from functools import partial

import pytest
import torch
from torch import nn
from torch.nn import functional as F

from rgbt.engine.optimizers import AdamW
from rgbt.models.dinov2.model import Level, Pyramid
from rgbt.types import VIEWS
from tests.models import plain
from tests.models.plain import cells, images, normal

nano = partial(plain.nano, "dinov2")
ADAMW = AdamW(
    **{"lr": 1.0, "backbone_multiplier": 0.1, "weight_decay": 0.05, "decay_biases": True},
    betas=(0.9, 0.999),
    eps=1e-8,
)


# ---- resizing and pyramid ------------------------------------------------------------------------


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


@pytest.mark.parametrize(("token_px", "widths"), [(16, (2, 4, 8, 8)), (8, (4, 8, 8, 8))])
def test_the_pyramid_has_the_strides_and_widths_of_vitdet(
    token_px: int, widths: tuple[int, ...]
) -> None:
    maps = Pyramid(8, token_px)([normal(1, 8, 64 // token_px, 96 // token_px)])
    sizes = [(1, c, 64 // s, 96 // s) for c, s in zip(widths, (4, 8, 16, 32), strict=True)]
    assert [tuple(each.shape) for each in maps] == sizes


@torch.no_grad()
def test_levels_equal_a_second_computation() -> None:
    x = normal(1, 4, 2, 3)
    finer = Level(4, token_px=8, stride=4)
    weight, bias = finer[0].weight, finer[0].bias  # (in, out, 2, 2), without overlap
    expected = torch.zeros(1, 2, 4, 6)
    for row in range(4):
        for column in range(6):
            pixel = x[0, :, row // 2, column // 2] @ weight[:, :, row % 2, column % 2] + bias
            expected[0, :, row, column] = F.layer_norm(pixel, (2,))
    torch.testing.assert_close(finer(x), expected)
    coarser = Level(4, token_px=8, stride=16)
    highest = x[..., :2, :2].amax((2, 3))
    torch.testing.assert_close(coarser(x[..., :2, :2])[..., 0, 0], F.layer_norm(highest, (4,)))


@torch.no_grad()
def test_every_level_takes_the_tokens_of_its_block() -> None:
    """With four blocks, a change of the third one reaches the levels of the third and fourth."""
    net = nano(layers=(1, 2, 3, 4)).eval()
    image = normal(1, 3, 32, 48)
    before = net.backbone.maps("rgb", image, None, None)
    net.backbone.encoder.blocks[2].mlp.fc2.bias.add_(1.0 * torch.arange(8))
    after = net.backbone.maps("rgb", image, None, None)
    same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    assert same == [True, True, False, False]


# ---- what is trained -----------------------------------------------------------------------------


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


@pytest.mark.parametrize("vector", [True, False])
def test_a_frozen_encoder_keeps_no_graph_of_rgb(vector: bool) -> None:
    net = nano(tuning="frozen", thermal_embedding=vector).train()
    seen: list[bool] = []
    net.backbone.encoder.register_forward_hook(
        lambda _m, _i, maps: seen.append(maps[0].requires_grad)
    )
    net(*images(2))
    assert seen == [False, vector]  # the vector of thermal images is trained
    assert ("backbone.thermal_embedding" in net.state_dict()) == vector


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
def test_the_thermal_vector_is_0_at_first_and_reaches_thermal_alone() -> None:
    net, pair = nano().eval(), images(1)
    assert not net.backbone.thermal_embedding.any()
    before = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    net.backbone.thermal_embedding.add_(torch.arange(8.0))
    after = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    assert [torch.equal(a, b) for a, b in zip(before, after, strict=True)] == [True, False]
