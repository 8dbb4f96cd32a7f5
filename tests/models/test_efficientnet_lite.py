"""EfficientNet-Lite: features of the package's own network, its statistics, and its mask token."""

from __future__ import annotations

import pytest
import torch

from rgbt.models.efficientnet_lite import MAPS, STEM, EfficientNetLite, LiteBackbone, channels
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
    ours = EfficientNetLite(*multipliers(size), 0.1).eval()
    found = ours.load_state_dict(theirs.state_dict(), strict=False)
    assert found.missing_keys == ["mask_token"]
    assert {name.split(".")[0] for name in found.unexpected_keys} == {"_conv_head", "_bn1", "_fc"}
    image = normal(2, 3, 64, 96)
    with torch.no_grad():
        x = theirs._swish(theirs._bn0(theirs._conv_stem(image)))
        of_blocks = []
        for block in theirs._blocks:
            x = block(x)
            of_blocks.append(x)
        maps = ours(image, None)
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
        blocks = [len(EfficientNetLite(*multipliers(size), 0.1)._blocks) for size in (0, 1, 2)]
    assert blocks == [16, 21, 21]
    # 4,652,008 parameters of Lite0 less its classifier of 1280 channels; and a mask token.
    with torch.device("meta"):
        encoder = EfficientNetLite(1.0, 1.0, 0.1)
    number = sum(weights.numel() for weights in encoder.parameters())
    assert number == 4_652_008 - (320 * 1280 + 2 * 1280 + 1281 * 1000) + STEM


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


@torch.no_grad()
def test_hidden_outputs_of_the_stem_are_the_token() -> None:
    """With all hidden, the maps are those of an image that only its stem's token knows."""
    encoder = nano("efficientnet_lite").eval().backbone.encoders["rgb"]
    randomise(encoder)
    hidden = torch.ones(1, 32, 32, dtype=torch.bool)
    first, second = (encoder(normal(1, 3, 64, 64, seed=seed), hidden) for seed in (0, 1))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True))
    hidden[:, :16] = False
    image = normal(1, 3, 64, 64)
    seen = []
    encoder._blocks[0].register_forward_hook(lambda _, given, __: seen.append(given[0]))
    encoder(image, hidden)
    encoder(image, None)
    assert torch.equal(seen[0][:, :, :16], seen[1][:, :, :16])
    assert torch.equal(seen[0][:, :, 16:], encoder.mask_token.expand(1, -1, 16, 32))


def test_branches_share_a_token_on_request() -> None:
    for kind in ("branch", "shared"):
        backbone = LiteBackbone(0.2, 0.5, None, fusion="max", mask_token=kind)
        tokens = [backbone.encoders[name].mask_token for name in ("rgb", "thermal")]
        assert (tokens[0] is tokens[1]) == (kind == "shared")
