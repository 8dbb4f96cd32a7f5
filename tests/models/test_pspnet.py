"""HeatNet's PSPNet: sizes, what is seen, a second computation, weights as drawn, dropout."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.pspnet import PSPNet
from rgbt.types import MaskPair
from tests.models.golden import network
from tests.models.plain import Plain, generator, half, images, randomise

NANO = {
    "num_classes": 4,
    "depths": (1, 2, 3, 2),
    "base_width": 4,
    "decoder_width": 5,
    "modalities": "late_fusion",
    "dropout": (0.3, 0.15),
    "align_corners": False,
}
ALL = ("late_fusion", "early_fusion", "rgb", "thermal")


def nano(**changes: Any) -> PSPNet:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return PSPNet(**{**NANO, "inputs": half(1), **changes})


@pytest.mark.parametrize(
    ("yaml", "num_classes", "count"),
    [
        ("heatnet", 14, 54_361_105),
        ("heatnet", 13, 54_361_040),
        ("heatnet_rgb", 14, 53_317_713),
        ("heatnet_rgb", 13, 53_317_648),
        ("heatnet_thermal", 14, 53_311_441),
        ("heatnet_thermal", 13, 53_311_376),
        ("heatnet_early", 14, 53_320_849),
    ],
)
def test_parameter_count(yaml: str, num_classes: int, count: int) -> None:
    with torch.device("meta"):
        net = network(yaml, num_classes)
    assert sum(parameter.numel() for parameter in net.parameters()) == count


@pytest.mark.parametrize("modalities", ALL)
@pytest.mark.parametrize("size", [(64, 96), (61, 83)])
def test_shapes(modalities: str, size: tuple[int, int]) -> None:
    net = nano(modalities=modalities).eval()
    with torch.no_grad():
        found = net(*images(2, *size))
    assert found.logits.shape == (2, 4, *size)
    branches = 2 if modalities == "late_fusion" else 1
    h, w = (-(-side // 8) for side in size)
    assert {name: tuple(x.shape[1:]) for name, x in found.aux.items()} == {
        "layer4": (128, h, w),
        "layer3": (64, h, w),
        "layer2": (32 * branches, h, w),
        "layer1": (16 * branches, 2 * h, 2 * w),
        "stem": (4 * branches, 2 * h, 2 * w),
    }


def test_sizes_of_the_release() -> None:
    with torch.device("meta"):
        net = network("heatnet", 14).eval()
        found = net(torch.empty(1, 3, 320, 640), torch.empty(1, 1, 320, 640))
    assert found.logits.shape == (1, 14, 320, 640)
    assert {name: tuple(x.shape[1:]) for name, x in found.aux.items()} == {
        "layer4": (2048, 40, 80),
        "layer3": (1024, 40, 80),
        "layer2": (1024, 40, 80),
        "layer1": (512, 80, 160),
        "stem": (128, 80, 160),
    }


def test_one_view() -> None:
    assert [nano(modalities=name).record.views for name in ALL] == [
        ("rgbt",),
        ("rgbt",),
        ("rgb",),
        ("thermal",),
    ]
    net, pair = nano(modalities="rgb").eval(), images(1, 32, 32)
    assert torch.equal(net(*pair).logits, net(*pair, views=("rgb",)).logits)
    with pytest.raises(InputError, match="PSPNet predicts from rgb"):
        net(*pair, views=("rgbt",))


@pytest.mark.parametrize("modalities", ALL)
def test_what_is_seen(modalities: str) -> None:
    net = nano(modalities=modalities).eval()
    randomise(net)
    rgb, thermal = images(1, 32, 32)
    with torch.no_grad():
        before = net(rgb, thermal).logits
        sees_rgb = not torch.equal(before, net(1 - rgb, thermal).logits)
        sees_thermal = not torch.equal(before, net(rgb, 1 - thermal).logits)
    assert sees_rgb == (modalities != "thermal")
    assert sees_thermal == (modalities != "rgb")


def reference(net: PSPNet, rgb: Tensor, thermal: Tensor) -> dict[str, Tensor]:
    """Late fusion at sides that are multiples of 8, written out."""
    plain, corners = Plain(net.state_dict()), net.psp.align_corners

    def enlarged(x: Tensor, size: tuple[int, ...]) -> Tensor:
        return F.interpolate(x, size=size, mode="bilinear", align_corners=corners)

    found: dict[str, list[Tensor]] = {"stem": [], "layer1": [], "layer2": []}
    for end, image in (("", 2 * rgb - 1), ("_2", 2 * thermal - 1)):
        x = plain.norm(f"feats.bn1{end}", plain.conv(f"feats.conv1{end}", image, stride=2))
        x = F.max_pool2d(x.clamp(min=0), 3, 2, 1)
        found["stem"].append(x)
        x = plain.stage(f"feats.layer1{end}", x)
        found["layer1"].append(x)
        found["layer2"].append(plain.stage(f"feats.layer2{end}", x, strides=(1, 2)))
    maps = {name: torch.cat(parts, 1) for name, parts in found.items()}
    maps["layer3"] = plain.stage("feats.layer3", maps["layer2"], dilations=(1, 2))
    maps["layer4"] = x = plain.stage("feats.layer4", maps["layer3"], dilations=(1, 4))

    pooled = [F.adaptive_avg_pool2d(x, bins) for bins in (1, 2, 3, 6)]
    small = [plain.conv(f"psp.stages.{index}.1", y) for index, y in enumerate(pooled)]
    joined = torch.cat([*(enlarged(y, x.shape[2:]) for y in small), x], 1)
    x = plain.conv("psp.bottleneck", joined).clamp(min=0)
    for name in ("up_1", "up_2", "up_3"):
        x = plain.up(name, x, align_corners=corners)
    return {**maps, "logits": plain.conv("final.0", x)}


@pytest.mark.parametrize("align_corners", [False, True])
def test_against_a_second_computation(align_corners: bool) -> None:
    net = nano(align_corners=align_corners).eval()
    randomise(net)
    rgb, thermal = images(2, 64, 88)
    with torch.no_grad():
        output, expected = net(rgb, thermal), reference(net, rgb, thermal)
    found = {**output.aux, "logits": output.logits}
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        torch.testing.assert_close(found[name], value, rtol=1e-4, atol=1e-5, msg=name)


def test_third_stage_keeps_its_input_after_two_branches() -> None:
    projected = {
        modalities: isinstance(nano(modalities=modalities).feats.layer3[0].downsample, nn.Identity)
        for modalities in ALL
    }
    assert projected == {name: name == "late_fusion" for name in ALL}


def test_weights_are_drawn_as_released() -> None:
    net = nano(base_width=16)
    convolutions = [m for m in net.modules() if isinstance(m, nn.Conv2d)]
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    drawn = torch.cat([m.weight.flatten() for m in convolutions])
    scales = torch.cat([m.weight for m in norms])
    assert drawn.mean().item() == pytest.approx(0, abs=1e-4)
    assert drawn.std().item() == pytest.approx(0.02, rel=0.01)
    assert scales.mean().item() == pytest.approx(1, abs=2e-3)
    assert scales.std().item() == pytest.approx(0.02, rel=0.1)
    assert all((m.bias == 0).all() for m in norms)
    # torch's own: uniform within one over the root of the fan-in
    assert net.psp.bottleneck.bias.abs().max().item() == pytest.approx(2560**-0.5, rel=0.02)
    assert [net.get_parameter(f"up_{i}.conv.2.weight").item() for i in (1, 2, 3)] == [0.25] * 3


def test_hidden_pixels_do_not_count() -> None:
    net = nano().eval()
    rgb, thermal = images(1, 64, 64)
    cells = torch.tensor([[[True, False], [False, False]]])
    masks = MaskPair(cells, torch.zeros_like(cells))
    other = rgb.clone()
    other[..., :32, :32] = 0.9
    seen = rgb.clone()
    seen[..., 32:, 32:] = 0.9
    with torch.no_grad():
        first = net(rgb, thermal, masks).logits
        assert torch.equal(first, net(other, thermal, masks).logits)
        assert not torch.equal(first, net(seen, thermal, masks).logits)
        assert not torch.equal(first, net(rgb, thermal).logits)


def test_dropped_channels_depend_on_the_generator_alone() -> None:
    net, pair = nano(), images(2, 32, 32)

    def logits(seed: int, global_seed: int) -> Tensor:
        torch.manual_seed(global_seed)
        return net(*pair, generator=generator(seed)).logits

    with torch.random.fork_rng():
        assert torch.equal(logits(0, 1), logits(0, 2))
        assert not torch.equal(logits(0, 1), logits(1, 1))
    with pytest.raises(ValueError, match="generator"):
        net(*pair)
    assert nano(dropout=(0.0, 0.0))(*pair).logits.shape == (2, 4, 32, 32)


def test_gradient_reaches_every_weight() -> None:
    net = nano()
    output = net(*images(2, 64, 64), generator=generator())
    F.cross_entropy(output.logits, torch.zeros(2, 64, 64, dtype=torch.int64)).backward()
    unmoved = {name for name, p in net.named_parameters() if not p.grad.abs().sum() > 0}
    # A bias before a normalisation cancels, up to rounding.
    assert unmoved <= {f"up_{index}.conv.0.bias" for index in (1, 2, 3)}


def test_pretrained_part_is_the_encoder() -> None:
    net = nano()
    names = {name.split(".")[0] for name, _ in net.named_parameters()}
    assert names == {"feats", "psp", "up_1", "up_2", "up_3", "final"}
    assert net.record.pretrained_parts == ("feats.",)
