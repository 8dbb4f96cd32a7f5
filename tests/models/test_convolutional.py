"""Convolutional networks: second computations where no record exists, what is seen, starts."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from tests.models.plain import Plain, count, generator, half, images, nano, randomise
from tests.models.test_contract import LITERAL, MODIFIED

Found = dict[str, Tensor]


def bilinear(x: Tensor, size: Any, *, corners: bool) -> Tensor:
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=corners)


def semseg(net: Any, rgb: Tensor, thermal: Tensor) -> Found:
    """Sides of 8 n + 1 pixels."""
    plain = Plain(net.state_dict())
    x = rgb if net.modalities == "rgb" else thermal.expand(-1, 3, -1, -1)
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


def deeplabv2(net: Any, image: Tensor, head: str, rates: tuple[int, ...]) -> Found:
    plain, hw = Plain(net.state_dict()), image.shape[2:]
    padded = F.pad(image, (0, -hw[1] % net.multiple, 0, -hw[0] % net.multiple))
    x = plain.normed("backbone.conv1", "backbone.bn1", padded, stride=2)
    x = F.max_pool2d(x.clamp(min=0), 3, 2, 1, ceil_mode=net.multiple == 1)
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
        scores = plain.up(f"heads.{head}.ups.{index}", scores, align_corners=False)
    if f"heads.{head}.final.weight" in plain.state:
        scores = plain.conv(f"heads.{head}.final", scores)
    both = {"logits": scores, "aux_logits": pyramid("auxiliary", layer3)}
    enlarged = {
        n: bilinear(x, padded.shape[2:], corners=net.multiple == 1) for n, x in both.items()
    }
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


@pytest.mark.parametrize("changes", [{}, MODIFIED, LITERAL])
@pytest.mark.parametrize(
    ("rates", "size"), [((2, 4, 6, 8), (96, 120)), ((2, 4), (96, 120)), ((2, 4), (61, 83))]
)
@torch.no_grad()
def test_values_of_deeplab_equal_a_second_computation(
    changes: dict[str, Any], rates: tuple[int, ...], size: tuple[int, int]
) -> None:
    net = nano("deeplabv2", **changes, summed_rates=rates).eval()
    randomise(net)
    rgb, thermal = images(2, *size)
    for view, head in (("rgb", "source"), ("thermal", "target")):
        image = rgb if view == "rgb" else thermal.expand_as(rgb)
        check(
            net(rgb, thermal, views=(view,), head=head), deeplabv2(net, 2 * image - 1, head, rates)
        )


@pytest.mark.parametrize(
    ("name", "changes", "view"),
    [
        *(("pspnet", {"modalities": m}, "rgbt") for m in ("late_fusion", "early_fusion")),
        *(
            (name, {"modalities": m}, m)
            for name in ("pspnet", "semseg")
            for m in ("rgb", "thermal")
        ),
        ("mfnet", {}, "rgbt"),
        ("rtfnet", {}, "rgbt"),
        ("deeplabv2", {}, "rgb"),
    ],
)
@torch.no_grad()
def test_what_is_seen(name: str, changes: dict[str, Any], view: str) -> None:
    net, (rgb, thermal) = nano(name, **changes).eval(), images(1, 61, 83)
    randomise(net)
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


@pytest.mark.parametrize("name", ["deeplabv2", "semseg", "mfnet", "rtfnet"])
@torch.no_grad()
def test_thermal_images_of_one_and_three_channels(name: str) -> None:
    """One backbone for RGB and thermal repeats the channel; a stem of its own has as many."""
    one, three = (nano(name, inputs=half(channels)).eval() for channels in (1, 3))
    if name in ("deeplabv2", "semseg"):
        three.load_state_dict(one.state_dict())
        views = one.record.views[-1:]
        assert torch.equal(*(net(*images(1), views=views).logits for net in (one, three)))
    else:
        assert count(three) > count(one)
        assert three(*images(1)).logits.shape == one(*images(1)).logits.shape


@pytest.mark.parametrize(
    ("name", "setting", "slope"), [("mfnet", "final_activation", 0.2), ("rtfnet", "final_relu", 0)]
)
def test_last_activation_bends_the_same_logits(name: str, setting: str, slope: float) -> None:
    bent, raw = (nano(name, **{setting: value}).eval() for value in (True, False))
    raw.load_state_dict(randomise(bent))
    with_it, without = bent(*images(1)).logits, raw(*images(1)).logits
    assert without.min() < 0
    torch.testing.assert_close(with_it, torch.where(without >= 0, without, without * slope))


@pytest.mark.parametrize(
    ("name", "others"),
    [
        ("rtfnet", {"deconv"}),
        ("semseg", {"ppm", "cls", "aux"}),
        ("deeplabv2", {"heads", "auxiliary"}),
        ("pspnet", {"psp", "up_", "final"}),
    ],
)
def test_new_modules_have_the_larger_rate(name: str, others: set[str]) -> None:
    net = nano(name)
    names = [each for each, _ in net.named_parameters()]
    new = [each for each in names if not each.startswith(net.record.pretrained_parts)]
    assert {each.split(".")[0].rstrip("12345") for each in new} == others
    assert len(new) < len(names)


# ---- DeepLab v2 ----------------------------------------------------------------------------------


def test_first_head_and_rgb_are_the_defaults() -> None:
    net, pair = nano("deeplabv2").eval(), images(1, 32, 32)
    with torch.no_grad():
        first = net(*pair).logits
        assert torch.equal(first, net(*pair, views=("rgb",), head="source").logits)
        assert not torch.equal(first, net(*pair, head="target").logits)
    with pytest.raises(InputError, match="did you mean 'target'"):
        net(*pair, head="targe")


def test_one_head_is_trained_alone_and_rates_that_do_not_count_are_parameters() -> None:
    net = nano("deeplabv2", auxiliary=False, summed_rates=(2, 4))
    assert count(net) == count(nano("deeplabv2", auxiliary=False))
    net(*images(2), head="target").logits.square().mean().backward()
    trained = {name for name, p in net.named_parameters() if p.grad is not None}
    counted = [f"heads.target.aspp.conv2d_list.{i}.{p}" for i in (0, 1) for p in ("weight", "bias")]
    backbone = [name for name, _ in net.named_parameters() if name.startswith("backbone.")]
    assert trained == {*backbone, *counted}


def test_statistics_move_where_norms_are_not_trained() -> None:
    net = nano("deeplabv2", train_norm="statistics", **MODIFIED)
    frozen = {name for name, p in net.named_parameters() if not p.requires_grad}
    norms = {name for name, each in net.named_modules() if isinstance(each, nn.BatchNorm2d)}
    own = [name for name in norms if name.startswith("backbone.")]
    assert frozen == {f"{name}.{part}" for name in own for part in ("weight", "bias")}
    assert len(own) < len(norms)
    assert all(p.requires_grad for p in nano("deeplabv2").parameters())
    before = net.backbone.bn1.running_mean.clone()
    net(*images(2, 32, 32), generator=generator())
    assert not torch.equal(before, net.backbone.bn1.running_mean)


# ---- initial weights -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "changes", "deviation"),
    [("deeplabv2", {"base_width": 8, **MODIFIED}, 0.01), ("pspnet", {"base_width": 16}, 0.02)],
)
def test_convolutions_are_drawn_as_released(
    name: str, changes: dict[str, Any], deviation: float
) -> None:
    net = nano(name, **changes)
    drawn = torch.cat([m.weight.flatten() for m in net.modules() if isinstance(m, nn.Conv2d)])
    assert drawn.mean().item() == pytest.approx(0, abs=1e-4)
    assert drawn.std().item() == pytest.approx(deviation, rel=0.01)
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    scales = torch.cat([m.weight for m in norms])
    assert scales.mean().item() == pytest.approx(1, abs=2e-3)
    expected = 0.02 if name == "pspnet" else 0.0
    assert scales.std().item() == pytest.approx(expected, rel=0.1)
    assert all((m.bias == 0).all() for m in norms)


def test_thermal_stem_of_rtfnet_starts_as_the_mean_of_the_rgb_stem_or_anew() -> None:
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


def test_encoders_start_by_fan_out_and_the_decoder_of_rtfnet_by_both_fans() -> None:
    """Normal, variance 2 / fan_out; decoder: uniform within sqrt(6 / both fans)."""
    net, other = nano("rtfnet", base_width=32), nano("semseg", base_width=64, depths=(1, 1, 1, 1))
    for weight, fan in (
        (net.encoder_thermal_layer3[1].conv2.weight, 9 * 128),
        (other.layer4[0].conv2.weight, 9 * 512),
    ):
        assert weight.std().item() == pytest.approx(math.sqrt(2 / fan), rel=0.02)
    for weight, fans in (
        (net.deconv1[0].conv2.weight, 9 * (256 + 256)),
        (net.deconv1[1].conv1.weight, 256 + 128),
        (net.deconv1[1].upsample[0].weight, 4 * (256 + 128)),
    ):
        bound = math.sqrt(6 / fans)
        assert 0.99 * bound < weight.abs().max().item() <= bound
        assert weight.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.02)
