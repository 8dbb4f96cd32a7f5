"""DeepLab v2: a second computation, heads, norms that are not trained, weights as drawn."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.deeplabv2 import DeepLabV2
from tests.models.golden import compose, network
from tests.models.plain import Plain, count, generator, images, nano, randomise
from tests.models.test_contract import LITERAL, MODIFIED


def test_rates_that_do_not_count_are_parameters_still() -> None:
    both = nano("deeplabv2"), nano("deeplabv2", summed_rates=(2, 4))
    assert both[0].state_dict().keys() == both[1].state_dict().keys()
    assert count(both[0]) == count(both[1])


def test_backbone_has_the_names_of_torchvision() -> None:
    with torch.device("meta"):
        net = network("deeplabv2", 14)
    assert count(net.backbone) == 42_500_160
    norm = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
    expected = {"conv1.weight", *(f"bn1.{part}" for part in norm)}
    for stage, blocks in enumerate((3, 4, 23, 3), 1):
        at = [f"layer{stage}.{block}" for block in range(blocks)]
        expected |= {f"{name}.conv{k}.weight" for name in at for k in (1, 2, 3)}
        expected |= {f"{name}.bn{k}.{part}" for name in at for k in (1, 2, 3) for part in norm}
        expected |= {f"{at[0]}.downsample.0.weight"}
        expected |= {f"{at[0]}.downsample.1.{part}" for part in norm}
    assert net.record.pretrained_parts == ("backbone.",)
    assert set(net.backbone.state_dict()) == expected
    heads = {f"main.aspp.conv2d_list.{i}.{part}" for i in range(4) for part in ("weight", "bias")}
    assert set(net.heads.state_dict()) == heads


@pytest.mark.parametrize(
    ("yaml", "ceil_mode", "size"),
    [
        ("deeplabv2", True, (41, 81)),
        ("deeplabv2", False, (40, 80)),
        ("deeplabv2_two_heads_modified", False, (40, 80)),
    ],
)
def test_sizes_of_the_release(yaml: str, ceil_mode: bool, size: tuple[int, int]) -> None:
    with torch.device("meta"):
        net = network(yaml, 14, depths="[1,1,1,1]", ceil_mode=ceil_mode).eval()
        image = torch.empty(1, 3, 320, 640)
        assert [tuple(x.shape) for x in net.backbone(image)] == [(1, 1024, *size), (1, 2048, *size)]
        assert net(image, image[:, :1]).logits.shape == (1, 14, 320, 640)


def reference(net: DeepLabV2, image: Tensor, head: str, rates: tuple[int, ...]) -> list[Tensor]:
    """Scores of a head and of the auxiliary one in evaluation mode, written out from weights."""
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
    size, corners = padded.shape[2:], net.multiple == 1
    found = (
        F.interpolate(maps, size=size, mode="bilinear", align_corners=corners)
        for maps in (scores, pyramid("auxiliary", layer3))
    )
    return [maps[..., : hw[0], : hw[1]] for maps in found]


@pytest.mark.parametrize("changes", [{}, MODIFIED, LITERAL])
@pytest.mark.parametrize(
    ("rates", "size"), [((2, 4, 6, 8), (96, 120)), ((2, 4), (96, 120)), ((2, 4), (61, 83))]
)
def test_values_equal_a_second_computation(
    changes: dict[str, Any], rates: tuple[int, ...], size: tuple[int, int]
) -> None:
    net = nano("deeplabv2", **changes, summed_rates=rates).eval()
    randomise(net)
    rgb, thermal = images(2, *size)
    with torch.no_grad():
        for view, head in (("rgb", "source"), ("thermal", "target")):
            image = rgb if view == "rgb" else thermal.expand_as(rgb)
            output = net(rgb, thermal, views=(view,), head=head)
            expected = reference(net, 2 * image - 1, head, rates)
            for found, value in zip((output.logits, output.aux["aux_logits"]), expected):
                torch.testing.assert_close(found, value, rtol=1e-4, atol=1e-5)


def test_first_head_and_rgb_are_the_defaults() -> None:
    net, pair = nano("deeplabv2").eval(), images(1, 32, 32)
    with torch.no_grad():
        first = net(*pair).logits
        assert torch.equal(first, net(*pair, views=("rgb",), head="source").logits)
        assert not torch.equal(first, net(*pair, head="target").logits)
    with pytest.raises(InputError, match="did you mean 'target'"):
        net(*pair, head="targe")


def test_one_head_is_trained_alone() -> None:
    net = nano("deeplabv2", auxiliary=False, summed_rates=(2, 4))
    net(*images(2), head="target").logits.square().mean().backward()
    trained = {name for name, p in net.named_parameters() if p.grad is not None}
    counted = [f"heads.target.aspp.conv2d_list.{i}.{p}" for i in (0, 1) for p in ("weight", "bias")]
    backbone = [name for name, _ in net.named_parameters() if name.startswith("backbone.")]
    assert trained == {*backbone, *counted}
    assert all(net.get_parameter(name).grad.abs().sum() > 0 for name in trained)


def test_statistics_move_where_norms_are_not_trained() -> None:
    net = nano("deeplabv2", train_norm="statistics", **MODIFIED)
    frozen = {name for name, p in net.named_parameters() if not p.requires_grad}
    norms = {
        f"{name}.{part}"
        for name, module in net.named_modules()
        if isinstance(module, nn.BatchNorm2d)
        for part in ("weight", "bias")
    }
    assert frozen == {name for name in norms if name.startswith("backbone.")}
    assert len(frozen) < len(norms)
    assert all(p.requires_grad for p in nano("deeplabv2").parameters())
    before = net.backbone.bn1.running_mean.clone()
    net(*images(2, 32, 32), generator=generator())
    assert not torch.equal(before, net.backbone.bn1.running_mean)


def test_caffe_inputs() -> None:
    net = network("deeplabv2_tiny", 3).eval()
    node = compose("model=deeplabv2_tiny", "model/inputs=caffe").model.inputs
    net.inputs = type(net.inputs)(**{k: v for k, v in node.items() if k != "_target_"})
    rgb = torch.tensor([1.0, 0.0, 0.2]).view(1, 3, 1, 1)
    found = net.inputs(rgb, torch.full((1, 1, 1, 1), 0.6))
    blue_green_red = [51 - 104.007, -116.669, 255 - 122.679]
    torch.testing.assert_close(found.rgb.flatten(), torch.tensor(blue_green_red))
    thermal = [153 - 104.007, 153 - 116.669, 153 - 122.679]
    torch.testing.assert_close(found.thermal.flatten(), torch.tensor(thermal))


def test_weights_are_drawn_as_released() -> None:
    net = nano("deeplabv2", base_width=8, **MODIFIED)
    drawn = torch.cat([m.weight.flatten() for m in net.modules() if isinstance(m, nn.Conv2d)])
    assert drawn.mean().item() == pytest.approx(0, abs=1e-4)
    assert drawn.std().item() == pytest.approx(0.01, rel=0.01)
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    assert all((m.weight == 1).all() and (m.bias == 0).all() for m in norms)
