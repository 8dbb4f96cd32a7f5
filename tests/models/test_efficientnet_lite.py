"""EfficientNet-Lite: features of the package's own network, its statistics, and its mask token."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from rgbt.models.efficientnet_lite import MAPS, EfficientNetLite, LiteBackbone, channels
from tests.models.plain import images, nano, normal, randomise


def multipliers(size: int) -> tuple[float, float]:
    """Factors of channels and blocks of Lite0, Lite1 and Lite2."""
    return ((1.0, 1.0), (1.0, 1.1), (1.1, 1.2))[size]


@pytest.mark.parametrize("size", [0, 1, 2])
def test_features_are_those_of_the_package(size: int) -> None:
    package = pytest.importorskip("efficientnet_lite_pytorch")
    theirs = package.EfficientNet.from_name(f"efficientnet-lite{size}", image_size=None)
    randomise(theirs)
    theirs.eval()
    ours = EfficientNetLite(*multipliers(size), 0.1, 0).eval()
    found = ours.load_state_dict(theirs.state_dict(), strict=False)
    assert found.missing_keys == []
    assert {name.split(".")[0] for name in found.unexpected_keys} == {"_conv_head", "_bn1", "_fc"}
    image = normal(2, 3, 64, 96)
    with torch.no_grad():
        x = theirs._swish(theirs._bn0(theirs._conv_stem(image)))
        of_blocks = []
        for block in theirs._blocks:
            x = block(x)
            of_blocks.append(x)
        x, maps = ours.stem(image), []
        for index in range(len(MAPS)):
            x = ours.level(index, x)
            maps.append(x)
    assert [level.shape[1:] for level in maps] == [
        (channels(multipliers(size)[0])[stage], 64 // stride, 96 // stride)
        for stage, stride in zip(MAPS, (4, 8, 16, 32), strict=True)
    ]
    for stage, level in zip(MAPS, maps, strict=True):
        expected = of_blocks[ours.last[stage]]
        assert (level - expected).abs().max() <= 1e-5 * expected.abs().max()


def test_sizes_are_those_of_the_release() -> None:
    """Lite2 grows 16 24 40 80 112 192 320 by 1.1, to multiples of 8; the stem stays."""
    assert channels(1.0) == [16, 24, 40, 80, 112, 192, 320]
    assert channels(1.1) == [16, 24, 48, 88, 120, 208, 352]
    with torch.device("meta"):
        blocks = [len(EfficientNetLite(*multipliers(size), 0.1, 0)._blocks) for size in (0, 1, 2)]
    assert blocks == [16, 21, 21]
    # 4,652,008 parameters of Lite0 less its classifier of 1280 channels.
    with torch.device("meta"):
        encoder = EfficientNetLite(1.0, 1.0, 0.1, 0)
    number = sum(weights.numel() for weights in encoder.parameters())
    assert number == 4_652_008 - (320 * 1280 + 2 * 1280 + 1281 * 1000)


def test_fixed_statistics_stay_in_training() -> None:
    for momentum in (None, 0.25):
        net = nano("efficientnet_lite", norm_momentum=momentum).train()
        mean = net.backbone.encoders["thermal"]._bn0.running_mean
        _, thermal = images(4)
        net(*images(4))
        encoder, shown = net.backbone.encoders["thermal"], thermal.expand(-1, 3, -1, -1)
        shown = torch.nn.functional.pad((shown - 0.5) / 0.5, (0, 1, 0, 1))
        expected = 0.25 * encoder._conv_stem(shown).mean((0, 2, 3))
        if momentum is None:
            assert not mean.any()
        else:
            assert torch.allclose(mean, expected, atol=1e-5)
    net = nano("efficientnet_lite", norm_momentum=None).train()
    assert net.backbone.norm_layers["res2"].training, "the fusion has statistics of its own"


@pytest.mark.parametrize("stages", [0, 1, 3, 7])
def test_frozen_stages_keep_weights_and_statistics(stages: int) -> None:
    encoder = EfficientNetLite(0.2, 0.5, 0.1, stages).train()
    end = encoder.last[stages - 1] + 1 if stages else 0
    frozen = {"_conv_stem", "_bn0", *(f"_blocks.{n}" for n in range(end))} if stages else set()
    before = {name: value.clone() for name, value in encoder.state_dict().items()}
    x = encoder.stem(normal(2, 3, 64, 64))
    for index in range(4):
        x = encoder.level(index, x)
    if stages < 7:
        x.sum().backward()
        torch.optim.SGD(encoder.parameters(), 1.0).step()
    changed = {name for name, x in encoder.state_dict().items() if not torch.equal(x, before[name])}
    of_frozen = {name for name in before if name.startswith(tuple(f"{part}." for part in frozen))}
    assert changed == before.keys() - of_frozen


@torch.no_grad()
def test_hidden_outputs_of_the_stem_are_the_token() -> None:
    backbone = nano("efficientnet_lite").eval().backbone
    randomise(backbone)
    hidden = torch.ones(1, 32, 32, dtype=torch.bool)
    seen = []
    backbone.encoders["rgb"]._blocks[0].register_forward_hook(lambda _, x, __: seen.append(x[0]))
    first, second = (
        backbone.maps("rgb", normal(1, 3, 64, 64, seed=seed), hidden, None) for seed in (0, 1)
    )
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    hidden[:, :16] = False
    image = normal(1, 3, 64, 64)
    for mask in (hidden, None):
        backbone.maps("rgb", image, mask, None)
    *_, masked, whole = seen
    assert torch.equal(masked[:, :, :16], whole[:, :, :16])
    token = backbone.mask_tokens["rgb"].expand(1, -1, 16, 32)
    assert torch.equal(masked[:, :, 16:], token)


def test_branches_share_a_token_on_request() -> None:
    for kind in ("branch", "shared"):
        tokens = LiteBackbone(0.2, 0.5, None, 0, fusion="max", mask_token=kind).mask_tokens
        assert (tokens["rgb"] is tokens["thermal"]) == (kind == "shared")


@torch.no_grad()
def test_streams_of_cmx_continue_with_what_the_rectification_returns() -> None:
    """Without it, thermal reaches RGB's second map; a stream alone would not change."""
    net = nano("lite_cmx").eval()
    randomise(net)
    seen: list[torch.Tensor] = []
    encoder = net.backbone["encoders"]["rgb"]
    later = encoder._blocks[encoder.last[MAPS[0]] + 1]
    later.register_forward_hook(lambda _, x, __: seen.append(x[0]))
    rgb, thermal = images(1)
    net(rgb, thermal)
    net(rgb, 1 - thermal)
    first = encoder.stem(net.inputs(rgb, thermal, multiple=32).rgb)
    rectified = net.backbone["FRMs"][0]
    assert not torch.equal(seen[0], seen[1])
    streams = [
        net.backbone["encoders"][name].level(0, x)
        for name, x in (("rgb", first), ("thermal", thermal_stem(net, rgb, thermal)))
    ]
    expected, _ = rectified(*(x.permute(0, 2, 3, 1) for x in streams))
    assert torch.allclose(seen[0], expected.permute(0, 3, 1, 2))


def thermal_stem(net: Any, rgb: torch.Tensor, thermal: torch.Tensor) -> torch.Tensor:
    shown = net.inputs(rgb, thermal, multiple=32).thermal
    return net.backbone["encoders"]["thermal"].stem(shown.expand(-1, 3, -1, -1))
