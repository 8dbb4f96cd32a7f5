"""DeepLab v2: parameter counts, sizes, a second computation, heads, frozen norms, dropout."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.models.deeplabv2.model import DeepLabV2
from rgbt.types import MaskPair
from tests.models.golden import compose, network
from tests.models.plain import Plain, generator, half, images, randomise

NANO = {
    "num_classes": 3,
    "depths": (1, 2, 2, 2),
    "base_width": 2,
    "ceil_mode": True,
    "train_norm": "all",
    "heads": ("source", "target"),
    "auxiliary": True,
    "decoder": "basic",
    "rates": (2, 4, 6, 8),
    "summed_rates": (2, 4, 6, 8),
    "dropout": (0.0, 0.0),
    "align_corners": True,
}
RELEASED = {
    "ceil_mode": False,
    "decoder": "modified_released",
    "dropout": (0.3, 0.15),
    "align_corners": False,
}
LITERAL = {"ceil_mode": False, "decoder": "modified_thesis", "align_corners": False}
HEADS = "[source,target]"
R50 = "[3,4,6,3]"


def nano(**changes: Any) -> DeepLabV2:
    with torch.random.fork_rng():
        torch.manual_seed(0)
        return DeepLabV2(**{**NANO, "inputs": half(3), **changes})


def on_meta(yaml: str, num_classes: int, **changes: Any) -> DeepLabV2:
    with torch.device("meta"):
        return network(yaml, num_classes, **changes)


def count(net: nn.Module) -> int:
    return sum(parameter.numel() for parameter in net.parameters())


@pytest.mark.parametrize(
    ("yaml", "num_classes", "changes", "expected"),
    [
        ("deeplabv2", 14, {}, 43_532_408),
        ("deeplabv2", 14, {"auxiliary": True}, 44_048_560),
        ("deeplabv2", 19, {"auxiliary": True}, 44_601_560),
        ("deeplabv2", 14, {"heads": HEADS}, 44_564_656),
        ("deeplabv2_two_heads_literal", 14, {}, 44_575_498),
        ("deeplabv2_two_heads_modified", 14, {}, 198_594_658),
        ("deeplabv2", 14, {"heads": HEADS, "depths": R50}, 25_572_528),
    ],
)
def test_parameter_count(
    yaml: str, num_classes: int, changes: dict[str, Any], expected: int
) -> None:
    assert count(on_meta(yaml, num_classes, **changes)) == expected


@pytest.mark.parametrize(
    ("yaml", "num_classes", "changes", "millions"),
    [
        ("deeplabv2", 14, {"depths": R50}, 24.540),
        ("deeplabv2", 14, {"depths": R50, "auxiliary": True}, 25.056),
        ("deeplabv2_two_heads_literal", 14, {"depths": R50}, 25.583),
        ("deeplabv2_two_heads_modified", 14, {"depths": R50}, 179.603),
        ("deeplabv2", 12, {"heads": HEADS}, 44.270),
        ("deeplabv2", 13, {"heads": HEADS}, 44.417),
    ],
)
def test_parameter_count_that_is_known_roughly(
    yaml: str, num_classes: int, changes: dict[str, Any], millions: float
) -> None:
    assert round(count(on_meta(yaml, num_classes, **changes)) / 1e6, 3) == millions


def test_rates_that_do_not_count_are_parameters_still() -> None:
    assert nano().state_dict().keys() == nano(summed_rates=(2, 4)).state_dict().keys()
    assert count(nano()) == count(nano(summed_rates=(2, 4)))


def test_backbone_has_the_names_of_torchvision() -> None:
    net = on_meta("deeplabv2", 14)
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
    names = set(net.state_dict())
    assert {f"backbone.{name}" for name in expected} == {n for n in names if "heads." not in n}
    parts = {f"{index}.{part}" for index in range(4) for part in ("weight", "bias")}
    assert {n for n in names if "heads." in n} == {
        f"heads.main.aspp.conv2d_list.{p}" for p in parts
    }


@pytest.mark.parametrize(
    ("yaml", "ceil_mode", "size"),
    [
        ("deeplabv2", True, (41, 81)),
        ("deeplabv2", False, (40, 80)),
        ("deeplabv2_two_heads_modified", False, (40, 80)),
    ],
)
def test_sizes_of_the_release(yaml: str, ceil_mode: bool, size: tuple[int, int]) -> None:
    net = on_meta(yaml, 14, depths="[1,1,1,1]", ceil_mode=ceil_mode).eval()
    image = torch.empty(1, 3, 320, 640, device="meta")
    assert [tuple(x.shape) for x in net.backbone(image)] == [(1, 1024, *size), (1, 2048, *size)]
    assert net(image, image[:, :1]).logits.shape == (1, 14, 320, 640)


@pytest.mark.parametrize("changes", [{}, RELEASED, LITERAL])
@pytest.mark.parametrize("size", [(64, 80), (61, 83)])
def test_shapes(changes: dict[str, Any], size: tuple[int, int]) -> None:
    with torch.no_grad():
        found = nano(**changes).eval()(*images(2, *size))
    assert found.logits.shape == found.aux["aux_logits"].shape == (2, 3, *size)
    assert nano(auxiliary=False).eval()(*images(1, *size)).aux == {}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"decoder": "modified_thesis"}, "model.ceil_mode=false"),
        ({"heads": ("day", "day")}, "model.heads"),
        ({"heads": ("day.one",)}, "model.heads"),
        ({"heads": ("train",)}, "model.heads"),
        ({"rates": (2, 2)}, "model.rates"),
        ({"summed_rates": (2, 3)}, "model.summed_rates"),
        ({"summed_rates": (2, 2)}, "model.summed_rates"),
        ({"dropout": (0.3, 0.15)}, "model.dropout"),
        ({"inputs": half(1)}, "model/inputs=half_three"),
    ],
)
def test_settings_that_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        nano(**changes)


def reference(net: DeepLabV2, image: Tensor, head: str, rates: tuple[int, ...]) -> list[Tensor]:
    """Scores of a head and of the auxiliary one in evaluation mode, written out from weights."""
    plain, hw = Plain(net.state_dict()), image.shape[2:]
    padded = F.pad(image, (0, -hw[1] % net.multiple, 0, -hw[0] % net.multiple))
    x = plain.norm("backbone.bn1", plain.conv("backbone.conv1", padded, stride=2))
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


@pytest.mark.parametrize("changes", [{}, RELEASED, LITERAL])
@pytest.mark.parametrize("rates", [(2, 4, 6, 8), (2, 4)])
@pytest.mark.parametrize("size", [(96, 120), (61, 83)])
def test_against_a_second_computation(
    changes: dict[str, Any], rates: tuple[int, ...], size: tuple[int, int]
) -> None:
    net = nano(**changes, summed_rates=rates).eval()
    randomise(net)
    rgb, thermal = images(2, *size)
    with torch.no_grad():
        for view, head in (("rgb", "source"), ("thermal", "target")):
            image = rgb if view == "rgb" else thermal.expand_as(rgb)
            output = net(rgb, thermal, views=(view,), head=head)
            expected = reference(net, 2 * image - 1, head, rates)
            for found, value in zip((output.logits, output.aux["aux_logits"]), expected):
                torch.testing.assert_close(found, value, rtol=1e-4, atol=1e-5)


def test_heads_and_views() -> None:
    net, pair = nano().eval(), images(1, 32, 32)
    assert net.record.views == ("rgb", "thermal")
    with torch.no_grad():
        first = net(*pair).logits
        assert torch.equal(first, net(*pair, views=("rgb",), head="source").logits)
        assert not torch.equal(first, net(*pair, head="target").logits)
        assert torch.equal(first, net(pair[0], 1 - pair[1]).logits)
        thermal = net(*pair, views=("thermal",)).logits
        assert torch.equal(thermal, net(1 - pair[0], pair[1], views=("thermal",)).logits)
    with pytest.raises(InputError, match="did you mean 'target'"):
        net(*pair, head="targe")
    with pytest.raises(InputError, match="DeepLabV2 predicts from rgb or thermal"):
        net(*pair, views=("rgbt",))


def test_a_head_is_trained_alone() -> None:
    net = nano(auxiliary=False, summed_rates=(2, 4))
    net(*images(2, 64, 64), head="target").logits.square().mean().backward()
    trained = {name for name, p in net.named_parameters() if p.grad is not None}
    assert trained == {
        *(name for name, _ in net.named_parameters() if name.startswith("backbone.")),
        *(
            f"heads.target.aspp.conv2d_list.{i}.{part}"
            for i in (0, 1)
            for part in ("weight", "bias")
        ),
    }
    assert all(net.get_parameter(name).grad.abs().sum() > 0 for name in trained)


def test_statistics_move_where_norms_are_not_trained() -> None:
    net = nano(train_norm="statistics", **RELEASED)
    frozen = {name for name, p in net.named_parameters() if not p.requires_grad}
    norms = {
        f"{name}.{part}"
        for name, module in net.named_modules()
        if isinstance(module, nn.BatchNorm2d)
        for part in ("weight", "bias")
    }
    assert frozen == {name for name in norms if name.startswith("backbone.")}
    assert len(frozen) < len(norms)
    assert all(p.requires_grad for p in nano().parameters())
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
    net = nano(base_width=8, **RELEASED)
    convolutions = [m for m in net.modules() if isinstance(m, nn.Conv2d)]
    drawn = torch.cat([m.weight.flatten() for m in convolutions])
    assert drawn.mean().item() == pytest.approx(0, abs=1e-4)
    assert drawn.std().item() == pytest.approx(0.01, rel=0.01)
    norms = [m for m in net.modules() if isinstance(m, nn.BatchNorm2d)]
    assert all((m.weight == 1).all() and (m.bias == 0).all() for m in norms)


def test_hidden_pixels_do_not_count() -> None:
    net = nano().eval()
    randomise(net)
    rgb, thermal = images(1, 64, 64)
    cells = torch.tensor([[[True, False], [False, False]]])
    masks = MaskPair(cells, torch.zeros_like(cells))
    other = rgb.clone()
    other[..., :32, :32] = 0.9
    with torch.no_grad():
        first = net(rgb, thermal, masks).logits
        assert torch.equal(first, net(other, thermal, masks).logits)
        assert not torch.equal(first, net(1 - rgb, thermal, masks).logits)
        assert not torch.equal(first, net(rgb, thermal).logits)


def test_dropped_channels_depend_on_the_generator_alone() -> None:
    net, pair = nano(**RELEASED), images(2, 32, 32)

    def logits(seed: int, global_seed: int) -> Tensor:
        torch.manual_seed(global_seed)
        return net(*pair, generator=generator(seed)).logits

    with torch.random.fork_rng():
        assert torch.equal(logits(0, 1), logits(0, 2))
        assert not torch.equal(logits(0, 1), logits(1, 1))
    with pytest.raises(ValueError, match="generator"):
        net(*pair)
    assert nano()(*pair).logits.shape == (2, 3, 32, 32)


@pytest.mark.parametrize("changes", [{}, RELEASED, LITERAL])
def test_gradient_reaches_every_weight(changes: dict[str, Any]) -> None:
    net = nano(**changes, base_width=4)
    label = torch.zeros(4, 64, 64, dtype=torch.int64)
    for head in ("source", "target"):
        output = net(*images(2, 64, 64), head=head, generator=generator())
        scores = torch.cat([output.logits, output.aux["aux_logits"]])
        F.cross_entropy(scores, label).backward()
    unmoved = {name for name, p in net.named_parameters() if not p.grad.abs().sum() > 0}
    # A bias before a normalisation cancels, up to rounding.
    assert unmoved <= {name for name, _ in net.named_parameters() if name.endswith("conv.0.bias")}
