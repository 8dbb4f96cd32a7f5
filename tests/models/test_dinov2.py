"""The network with DINOv2's encoder: views, passes, masks, pyramid, and what is trained."""

from __future__ import annotations

from functools import partial
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.engine.optimizers import AdamW
from rgbt.models.dinov2.model import Level, Pyramid
from rgbt.types import MaskPair
from tests.models import plain
from tests.models.plain import generator, half, images, normal, randomise
from tests.models.test_mask2former import ALL_VIEWS, cells

nano = partial(plain.nano, "dinov2")
ADAMW = AdamW(
    **{"lr": 1.0, "backbone_multiplier": 0.1, "weight_decay": 0.05, "decay_biases": True},
    betas=(0.9, 0.999),
    eps=1e-8,
)


@pytest.mark.parametrize("size", [(64, 96), (60, 84)])
def test_shapes(size: tuple[int, int]) -> None:
    out = nano().eval()(*images(2, *size))
    assert out.logits.shape == (2, 4, *size)
    assert out.aux["class_logits"].shape == (4, 1, 2, 5, 5)
    assert out.aux["mask_logits"].shape == (4, 1, 2, 5, 16, 24)
    assert nano().train()(*images(2, *size)).logits is None


def test_padding_is_the_mean_colour() -> None:
    net, pair = nano().eval(), images(1, 60, 84)
    full = net(*(F.pad(image, (0, 12, 0, 4), value=0.5) for image in pair))
    torch.testing.assert_close(net(*pair).logits, full.logits[..., :60, :84])


@pytest.mark.parametrize("training", [False, True])
@torch.no_grad()
def test_batched_views_and_passes_equal_single_calls(training: bool) -> None:
    rgb, thermal = images(2)
    hidden, nothing = cells(2), MaskPair(*(torch.zeros(2, 2, 3).bool() for _ in range(2)))
    both = MaskPair(*(torch.cat(pair) for pair in zip(nothing, hidden, strict=True)))
    net = nano().train(training)
    pair = rgb.repeat(2, 1, 1, 1), thermal.repeat(2, 1, 1, 1)
    out = net(*pair, both, passes=2, views=ALL_VIEWS)
    assert out.aux["class_logits"].shape[:3] == (4, 6, 2)
    for number, masks in enumerate((None, hidden)):
        for offset, view in enumerate(ALL_VIEWS):
            single = net(rgb, thermal, masks, views=(view,))
            for name in ("class_logits", "mask_logits"):
                found = out.aux[name][:, 3 * number + offset]
                expected = single.aux[name][:, 0]
                torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(("view", "idle"), [("rgb", "thermal"), ("thermal", "rgb")])
def test_single_modality_does_not_run_the_other(view: str, idle: str) -> None:
    net = nano().eval()

    def fail(*_: object) -> None:
        raise AssertionError(f"{idle} ran")

    net.backbone.pyramids[idle].register_forward_pre_hook(fail)
    assert net(*images(1), views=(view,)).logits is not None
    with pytest.raises(AssertionError, match="ran"):
        net(*images(1))


@torch.no_grad()
def test_hidden_pixels_do_not_count() -> None:
    net = nano().eval()
    randomise(net)
    pair, masks = images(1), cells(1, 2, 3, seed=2)
    changed = tuple(
        torch.where(hidden[:, None].repeat_interleave(32, 2).repeat_interleave(32, 3), 0.9, image)
        for image, hidden in zip(pair, masks, strict=True)
    )
    assert torch.equal(net(*pair, masks).logits, net(*changed, masks).logits)
    assert not torch.allclose(net(*pair).logits, net(*changed).logits)


@pytest.mark.parametrize("grid", [(3, 3), (32, 48), (16, 24)])
def test_cells_that_are_smaller_than_a_token_are_named(grid: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="patch size"):
        nano().eval()(*images(1), cells(1, *grid))


# ---- resizing and pyramid ------------------------------------------------------------------------


@pytest.mark.parametrize(("patch", "token_px", "hw"), [(4, 8, (32, 48)), (14, 16, (56, 84))])
def test_a_patch_covers_token_px_pixels(patch: int, token_px: int, hw: tuple[int, int]) -> None:
    net, seen = nano(patch=patch, token_px=token_px).eval(), []
    net.backbone.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0].shape))
    net(*images(1))
    assert [tuple(shape[2:]) for shape in seen] == [hw, hw]


def test_images_are_not_resized_where_a_patch_has_as_many_pixels() -> None:
    net, seen = nano(patch=8, token_px=8).eval(), []
    net.backbone.encoder.register_forward_pre_hook(lambda _, args: seen.append(args[0]))
    pair = images(1)
    net(*pair)
    torch.testing.assert_close(seen[0], 2 * pair[0] - 1)
    torch.testing.assert_close(seen[1], (2 * pair[1] - 1).expand(-1, 3, -1, -1))


@pytest.mark.parametrize(
    ("token_px", "widths"), [(16, (2, 4, 8, 8)), (8, (4, 8, 8, 8))], ids=["16", "8"]
)
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
    before = net.backbone._maps("rgb", image, None)
    net.backbone.encoder.blocks[2].mlp.fc2.bias.add_(1.0 * torch.arange(8))
    after = net.backbone._maps("rgb", image, None)
    same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
    assert same == [True, True, False, False]


# ---- what is trained -----------------------------------------------------------------------------


def trained(net: nn.Module) -> set[str]:
    return {name for name, parameter in net.named_parameters() if parameter.requires_grad}


def step(net: nn.Module) -> Tensor:
    """The gradient of a pass of CRM."""
    aux = net(*images(4), cells(4), passes=2, views=ALL_VIEWS, generator=generator()).aux
    g = generator(2)
    loss = sum((x * torch.randn(x.shape, generator=g)).sum() for x in aux.values())
    assert isinstance(loss, Tensor)
    loss.backward()
    return loss


@pytest.mark.parametrize("layers", [(4,), (1, 2, 3, 4)])
@pytest.mark.parametrize("tuning", ["full", "lora"])
def test_gradient_reaches_every_trained_parameter(tuning: str, layers: tuple[int, ...]) -> None:
    net = nano(tuning=tuning, layers=layers).train()
    randomise(net)
    step(net)
    parameters = {name: p for name, p in net.named_parameters() if p.requires_grad}
    idle = {n for n, p in parameters.items() if p.grad is None or not p.grad.any()}
    assert idle == set()
    assert all(p.grad.isfinite().all() for p in parameters.values())


@pytest.mark.parametrize("tuning", ["frozen", "lora"])
def test_the_encoder_is_not_trained(tuning: str) -> None:
    net = nano(tuning=tuning).train()
    encoder = {n for n, _ in net.named_parameters() if n.startswith("backbone.encoder.")}
    assert not encoder & trained(net)
    before = {name: value.clone() for name, value in net.backbone.encoder.state_dict().items()}
    optimizer = ADAMW(net)
    listed = {id(p) for group in optimizer.param_groups for p in group["params"]}
    assert listed == {id(p) for p in net.parameters() if p.requires_grad}
    step(net)
    optimizer.step()
    assert all(p.grad is None for p in net.backbone.encoder.parameters())
    after = net.backbone.encoder.state_dict()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    assert any(name.startswith("backbone.lora.") for name in trained(net)) == (tuning == "lora")


def test_a_frozen_encoder_keeps_no_graph_of_rgb() -> None:
    net = nano(tuning="frozen").train()
    seen: list[bool] = []
    net.backbone.encoder.register_forward_hook(
        lambda _m, _i, maps: seen.append(maps[0].requires_grad)
    )
    net(*images(2))
    assert seen == [False, True]  # the vector of thermal images is trained
    seen.clear()
    without = nano(tuning="frozen", thermal_embedding=False).train()
    without.backbone.encoder.register_forward_hook(
        lambda _m, _i, maps: seen.append(maps[0].requires_grad)
    )
    without(*images(2))
    assert seen == [False, False]
    assert "backbone.thermal_embedding" not in without.state_dict()


@pytest.mark.parametrize("per_modality", [True, False])
@torch.no_grad()
def test_updates_change_nothing_at_first(per_modality: bool) -> None:
    plain_net = nano(tuning="frozen").eval()
    net = nano(tuning="lora", lora_per_modality=per_modality).eval()
    own = {k: v for k, v in net.state_dict().items() if k.startswith("backbone.lora.")}
    assert {key.split(".")[2] for key in own} == ({"rgb", "thermal"} if per_modality else {"both"})
    net.load_state_dict({**plain_net.state_dict(), **own})
    pair, masks = images(2), cells(2)
    for view in ALL_VIEWS:
        for hidden in (None, masks):
            mine, theirs = (each(*pair, hidden, views=(view,)) for each in (net, plain_net))
            assert torch.equal(mine.logits, theirs.logits)


@torch.no_grad()
def test_updates_of_thermal_do_not_reach_rgb() -> None:
    for per_modality, owner in ((True, "thermal"), (False, "both")):
        net, pair = nano(tuning="lora", lora_per_modality=per_modality).eval(), images(1)
        before = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
        net.backbone.lora[owner][0].up["v"].copy_(normal(8, 2))
        after = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
        same = [torch.equal(a, b) for a, b in zip(before, after, strict=True)]
        assert same == [per_modality, False]


@torch.no_grad()
def test_the_thermal_vector_is_0_at_first_and_reaches_thermal_alone() -> None:
    net, pair = nano().eval(), images(1)
    assert not net.backbone.thermal_embedding.any()
    before = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    net.backbone.thermal_embedding.add_(torch.arange(8.0))
    after = [net(*pair, views=(view,)).logits for view in ("rgb", "thermal")]
    assert [torch.equal(a, b) for a, b in zip(before, after, strict=True)] == [True, False]


def test_the_learning_rate_of_the_backbone_is_that_of_the_encoder_alone() -> None:
    net = nano(tuning="full")
    encoder = {id(p) for p in net.backbone.encoder.parameters()}
    for group in ADAMW(net).param_groups:
        for parameter in group["params"]:
            assert group["lr"] == pytest.approx(0.1 if id(parameter) in encoder else 1.0)


# ---- settings ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"embed_dim": 6}, r"model\.embed_dim must be a multiple of 4"),
        ({"num_heads": 3}, r"model\.num_heads = 3"),
        ({"layers": (5,)}, r"model\.layers"),
        ({"layers": (1, 4)}, r"model\.layers"),
        ({"layers": (1, 3, 2, 4)}, r"model\.layers"),
        ({"lora_parts": ("q", "q")}, r"model\.lora_parts"),
        ({"inputs": half(1)}, r"model/inputs=cmx"),
        ({"hidden_dim": 48}, r"model\.hidden_dim"),
    ],
)
def test_settings_that_do_not_fit_name_the_key(changes: dict[str, Any], word: str) -> None:
    with pytest.raises(InputError, match=word):
        nano(**changes)
