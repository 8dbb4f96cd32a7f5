"""Inputs and convolutional networks: by hand, by second computations, what is seen, starts."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.models.parts import (
    BasicBlock,
    Bottleneck,
    bottleneck_stage,
    drop_channels,
    enlarge,
    keep_factors,
)
from rgbt.types import MaskPair
from tests.models.plain import Plain, generator, half, images, nano, normal, randomise
from tests.models.test_contract import CASES, LITERAL, MODIFIED

# ---- inputs ----


def inputs(**changes: Any) -> Inputs:
    values: dict[str, Any] = {
        "rgb_order": "rgb",
        "rgb_mean": (0.0, 51.0, 102.0),
        "rgb_std": (255.0, 51.0, 25.5),
        "thermal_mean": (0.0,),
        "thermal_std": (255.0,),
        "thermal_scale": "fixed",
    }
    return Inputs(**{**values, **changes})


def ones(height: int = 32, width: int = 32, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(count, 3, height, width), torch.full((count, 1, height, width), 0.5)


def test_bgr_swaps_the_images_channels_and_not_the_means() -> None:
    red = torch.tensor([1.0, 0.0, 0.0]).view(1, 3, 1, 1).expand(1, 3, 32, 32)
    rgb, _ = inputs(rgb_order="bgr")(red, ones()[1])
    assert rgb[0, :, 0, 0].tolist() == pytest.approx([0.0, -1.0, 6.0])


def test_gray_is_the_luma_in_all_three_channels() -> None:
    image = torch.tensor([1.0, 0.5, 0.25]).view(1, 3, 1, 1).expand(1, 3, 32, 32)
    rgb, _ = inputs(rgb_order="gray")(image, ones()[1])
    grey = 255 * (0.299 + 0.587 / 2 + 0.114 / 4)  # ITU-R BT.601
    expected = [grey / 255, (grey - 51) / 51, (grey - 102) / 25.5]
    assert rgb[0, :, 5, 7].tolist() == pytest.approx(expected, rel=1e-5)


def test_every_thermal_image_is_divided_by_its_own_maximum() -> None:
    rgb, thermal = ones(count=3)
    thermal[0, 0, 0, 0], thermal[1], thermal[2] = 0.25, 0.125, 0.0
    _, scaled = inputs(thermal_scale="image_max")(rgb, thermal)
    assert [factor.unique().tolist() for factor in scaled] == [[0.5, 1.0], [1.0], [0.0]]


def test_padding_and_hidden_pixels_are_the_mean() -> None:
    rgb, thermal = ones(40, 60)
    hidden = torch.zeros(1, 2, 2, dtype=torch.bool)
    hidden[0, 1, 1] = True
    images = inputs()(rgb, thermal, MaskPair(hidden, ~hidden), multiple=32)
    assert images.rgb.shape[-2:] == images.thermal.shape[-2:] == (64, 64)
    assert images.rgb[..., 40:, :].abs().sum() == images.rgb[..., 60:].abs().sum() == 0
    # Cells are 32 x 32 of the padded image: rows 32..39 and columns 32..59 are hidden in RGB.
    assert (images.rgb[0, 0, :40, :60] == 0).sum() == 8 * 28
    assert (images.thermal[0, 0, :40, :60] != 0).sum() == 8 * 28


def test_cells_become_squares_of_units() -> None:
    hidden = torch.tensor([[[True, False]]])
    pixels = expand_cells(MaskPair(hidden, hidden), 1, (32, 64))
    assert pixels.rgb.shape == (1, 32, 64)
    assert pixels.rgb[0, :, :32].all()
    assert not pixels.rgb[0, :, 32:].any()
    assert expand_cells(MaskPair(hidden, hidden), 1, (32, 64), 4).thermal.shape == (1, 8, 16)
    for grid, unit in (((3, 2), 1), ((1, 1), 1), ((16, 32), 4)):
        hidden = torch.zeros(1, *grid, dtype=torch.bool)
        with pytest.raises(InputError, match=r"masker.patch_size"):
            expand_cells(MaskPair(hidden, hidden), 1, (32, 64), unit)


# ---- parts and the discriminator ----


@pytest.mark.parametrize(
    ("stage", "strides", "dilations"),
    [
        (nn.Sequential(BasicBlock(6, 6)), (1, 1), (1, 1)),
        (nn.Sequential(BasicBlock(6, 6, stride=2)), (2, 1), (1, 1)),
        (nn.Sequential(Bottleneck(8, 2, stride=2, dilation=3)), (1, 2), (3, 1)),
        (bottleneck_stage(3, 2, 3, dilations=(2, 4)), (1, 1), (2, 4)),
        (bottleneck_stage(3, 2, 3, stride=2, dilations=(1, 2), stride_at="1x1"), (2, 1), (1, 2)),
    ],
)
def test_residual_blocks_by_their_weights(
    stage: Any, strides: tuple[int, int], dilations: tuple[int, int]
) -> None:
    plain = Plain(randomise(nn.ModuleDict({"a": stage}).eval()))
    x = normal(2, stage[0].conv1.in_channels, 9, 12)
    expected = plain.stage("a", x, strides=strides, dilations=dilations)
    assert (expected > 0).float().mean() > 0.2
    torch.testing.assert_close(stage(x), expected, rtol=1e-4, atol=1e-5)


def test_factors_are_zero_or_the_inverse_of_the_probability() -> None:
    factors = keep_factors(torch.tensor([0.0, 0.2]), (2, 5000), generator(), torch.device("cpu"))
    assert factors.shape == (2, 2, 5000)
    assert factors[0].unique().tolist() == [1.0]
    assert factors[1].unique().tolist() == [0.0, 1.25]
    # 10,000 draws: standard error 0.005.
    assert factors[1].mean().item() == pytest.approx(1.0, abs=0.02)


def test_channels_are_dropped_before_and_after_every_block() -> None:
    x, seen = torch.ones(4, 500, 2, 2), []
    blocks = [nn.Identity(), nn.Identity()]
    for block in blocks:
        block.register_forward_pre_hook(lambda _m, args: seen.append(args[0]))
    result = enlarge(x, blocks, (0.5, 0.2), generator())
    for found, values, dropped in zip(
        (*seen, result),
        ({0.0, 2.0}, {0.0, 2.5}, {0.0, 3.125}),
        (0.5, 1 - 0.5 * 0.8, 1 - 0.5 * 0.8**2),
        strict=True,
    ):
        assert torch.equal(found.amin((2, 3)), found.amax((2, 3)))
        assert set(found.unique().tolist()) == values
        # 2,000 draws: standard error 0.011
        assert (found == 0).float().mean().item() == pytest.approx(dropped, abs=0.05)
    assert torch.equal(enlarge(x, blocks, (0.0, 0.0), None), x)
    with pytest.raises(ValueError, match="generator"):
        drop_channels(x, 0.5, None)


# ---- networks ----
Found = dict[str, Tensor]


def bilinear(x: Tensor, size: Any, *, corners: bool) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=corners)


def semseg(net: Any, rgb: Tensor, thermal: Tensor) -> Found:
    """Sides of 8 n + 1 pixels."""
    plain = Plain(net.state_dict())
    x = rgb if net.record.views == ("rgb",) else thermal.expand(-1, 3, -1, -1)
    for number, stride in ((0, 2), (3, 1), (6, 1)):
        x = plain.normed(f"layer0.{number}", f"layer0.{number + 1}", x, stride=stride).relu()
    x = plain.stage("layer1", F.max_pool2d(x, 3, 2, 1))
    x = plain.stage("layer2", x, strides=(1, 2))
    layer3 = plain.stage("layer3", x, dilations=(2, 2))
    x = plain.stage("layer4", layer3, dilations=(4, 4))
    joined = [x]
    for index, bins in enumerate((1, 2, 3, 6)):
        name = f"ppm.features.{index}"
        small = plain.normed(f"{name}.1", f"{name}.2", F.adaptive_avg_pool2d(x, bins)).relu()
        joined.append(bilinear(small, x.shape[2:], corners=True))

    def scores(head: str, features: Tensor) -> Tensor:
        found = plain.conv(f"{head}.4", plain.normed(f"{head}.0", f"{head}.1", features).relu())
        return bilinear(found, (8 * (side - 1) + 1 for side in found.shape[2:]), corners=True)

    cls, aux = scores("cls", torch.cat(joined, 1)), scores("aux", layer3)
    return {"logits": cls, "features": x, "aux_logits": aux}


def deeplabv2(
    net: Any, image: Tensor, head: str, rates: tuple[int, ...], *, ceil: bool, corners: bool
) -> Found:
    plain, hw = Plain(net.state_dict()), image.shape[2:]
    padded = F.pad(image, (0, -hw[1] % net.multiple, 0, -hw[0] % net.multiple))
    x = plain.normed("backbone.conv1", "backbone.bn1", padded, stride=2)
    x = F.max_pool2d(x.clamp(min=0), 3, 2, 1, ceil_mode=ceil)
    x = plain.stage("backbone.layer1", x)
    x = plain.stage("backbone.layer2", x, strides=(2, 1))
    layer3 = plain.stage("backbone.layer3", x, dilations=(2, 2))
    layer4 = plain.stage("backbone.layer4", layer3, dilations=(4, 4))

    def pyramid(name: str, x: Tensor) -> Tensor:
        names = [f"{name}.conv2d_list.{(2, 4, 6, 8).index(rate)}" for rate in rates]
        scores = [plain.conv(at, x, dilation=rate) for at, rate in zip(names, rates)]
        return torch.stack(scores).sum(0)

    scores = pyramid(f"heads.{head}.aspp", layer4)
    for index in range(len(net.heads[head].ups)):
        scores = plain.up(f"heads.{head}.ups.{index}", scores, align_corners=corners)
    if f"heads.{head}.final.weight" in plain.state:
        scores = plain.conv(f"heads.{head}.final", scores)
    both = {"logits": scores, "aux_logits": pyramid("auxiliary", layer3)}
    enlarged = {n: bilinear(x, padded.shape[2:], corners=corners) for n, x in both.items()}
    return {n: x[..., : hw[0], : hw[1]] for n, x in enlarged.items()} | {"features": layer4}


def check(output: Any, expected: Found) -> None:
    found = {**output.aux, "logits": output.logits}
    assert found.keys() == expected.keys()
    assert expected["logits"].std() > 0.05
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-4, msg=name)


@pytest.mark.parametrize("modalities", ["rgb", "thermal"])
@torch.no_grad()
def test_values_of_semseg_equal_a_second_computation(modalities: str) -> None:
    net = nano("semseg", modalities=modalities).eval()
    randomise(net)
    rgb, thermal = images(2, 65, 89)
    check(net(rgb, thermal), semseg(net, 2 * rgb - 1, 2 * thermal - 1))


@pytest.mark.parametrize(
    "changes",
    # Each of the two settings alone, too.
    [{}, MODIFIED, LITERAL, {"ceil_mode": False}, {"align_corners": False}]
    + [LITERAL | {"align_corners": True}],
)
@pytest.mark.parametrize(("rates", "size"), [((2, 4, 6, 8), (96, 120)), ((2, 4), (61, 83))])
@torch.no_grad()
def test_values_of_deeplab_equal_a_second_computation(
    changes: dict[str, Any], rates: tuple[int, ...], size: tuple[int, int]
) -> None:
    net = nano("deeplabv2", **changes, summed_rates=rates).eval()
    assert len(net.heads["source"]["aspp"].conv2d_list) == 4, "others belong to the parameters"
    randomise(net)
    rgb, thermal = images(2, *size)
    for view, head in (("rgb", "source"), ("thermal", "target")):
        image = rgb if view == "rgb" else thermal.expand_as(rgb)
        found = net(rgb, thermal, views=(view,), head=head)
        ceil, corners = (changes.get(name, True) for name in ("ceil_mode", "align_corners"))
        expected = deeplabv2(net, 2 * image - 1, head, rates, ceil=ceil, corners=corners)
        check(found, expected)


@pytest.mark.parametrize("corners", [False, True])
@torch.no_grad()
def test_the_critic_enlarges_its_verdicts(corners: bool) -> None:
    maps = normal(1, 2, 64, 96)
    small = nano("critic")(maps)
    assert small.shape == (1, 1, 2, 3)
    found = nano("critic", upsample=True, align_corners=corners)(maps)
    torch.testing.assert_close(found, bilinear(small, (64, 96), corners=corners))


@pytest.mark.parametrize(("name", "changes"), CASES)
@torch.no_grad()
def test_the_images_of_the_first_view_are_seen(name: str, changes: dict[str, Any]) -> None:
    net, (rgb, thermal) = nano(name, **changes).eval(), images(1, 61, 83)
    randomise(net)
    view = changes.get("modalities", "rgb" if name in ("semseg", "deeplabv2") else "rgbt")
    view = "rgbt" if "fusion" in view else view
    assert net.record.views[0] == view
    before = net(rgb, thermal).logits
    sees_rgb = not torch.equal(before, net(1 - rgb, thermal).logits)
    sees_thermal = not torch.equal(before, net(rgb, 1 - thermal).logits)
    assert (sees_rgb, sees_thermal) == (view != "thermal", view != "rgb")


@torch.no_grad()
def test_thermal_encoder_of_rtfnet_never_sees_the_rgb_image() -> None:
    net, seen = nano("rtfnet").eval(), []
    net.encoder_thermal_layer4.register_forward_hook(lambda _m, _i, out: seen.append(out))
    rgb, thermal = images(1)
    assert not torch.equal(net(rgb, thermal).logits, net(1 - rgb, thermal).logits)
    assert torch.equal(*seen)


@pytest.mark.parametrize(
    ("name", "setting", "slope"), [("mfnet", "final_activation", 0.2), ("rtfnet", "final_relu", 0)]
)
def test_last_activation_bends_the_same_logits(name: str, setting: str, slope: float) -> None:
    bent, raw = (nano(name, **{setting: value}).eval() for value in (True, False))
    raw.load_state_dict(randomise(bent))
    with_it, without = bent(*images(1)).logits, raw(*images(1)).logits
    assert without.min() < 0
    torch.testing.assert_close(with_it, torch.where(without >= 0, without, without * slope))


def test_first_head_and_rgb_are_the_defaults() -> None:
    net, pair = nano("deeplabv2").eval(), images(1, 32, 32)
    with torch.no_grad():
        first = net(*pair).logits
        assert torch.equal(first, net(*pair, views=("rgb",), head="source").logits)
        assert not torch.equal(first, net(*pair, head="target").logits)
    with pytest.raises(InputError, match="did you mean 'target'"):
        net(*pair, head="targe")


def test_statistics_move_where_norms_are_not_trained() -> None:
    net = nano("deeplabv2", train_norm="statistics", **MODIFIED)
    frozen = {name for name, p in net.named_parameters() if not p.requires_grad}
    norms = {name for name, module in net.named_modules() if isinstance(module, nn.BatchNorm2d)}
    own = [name for name in norms if name.startswith("backbone.")]
    assert frozen == {f"{name}.{part}" for name in own for part in ("weight", "bias")}
    assert len(own) < len(norms)
    assert all(p.requires_grad for p in nano("deeplabv2").parameters())
    before = net.backbone.bn1.running_mean.clone()
    net(*images(2, 32, 32), generator=generator())
    assert not torch.equal(before, net.backbone.bn1.running_mean)


def test_thermal_stem_of_rtfnet_starts_as_mean_or_anew() -> None:
    mean, anew = nano("rtfnet"), nano("rtfnet", thermal_stem="xavier")
    weight = mean.encoder_rgb_conv1.weight
    expected = (weight[:, 0] + weight[:, 1] + weight[:, 2]) / 3
    torch.testing.assert_close(mean.encoder_thermal_conv1.weight[:, 0], expected)
    # Xavier, uniform: bound sqrt(6 / (fan_in + fan_out)) = sqrt(6 / (49 * 1 + 49 * 4)).
    bound = math.sqrt(6 / 245)
    assert 0.95 * bound < anew.encoder_thermal_conv1.weight.abs().max().item() <= bound
    assert list(anew.record.drawn_anew) == ["encoder_thermal_conv1."]
    three = nano("rtfnet", inputs=half(3))
    assert torch.equal(three.encoder_thermal_conv1.weight, three.encoder_rgb_conv1.weight)
