"""Residual blocks by their weights, random drops, up blocks, the discriminator by plain loops."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import nn

from rgbt.checks import InputError
from rgbt.models.parts import UpBlock, drop_channels, enlarge, keep_factors
from rgbt.models.resnet import BasicBlock, Bottleneck, bottleneck_stage
from tests.models.plain import Plain, count, generator, nano, normal, randomise


@pytest.mark.parametrize(
    ("stage", "strides", "dilations"),
    [
        (nn.Sequential(BasicBlock(6, 6)), (1, 1), (1, 1)),
        (nn.Sequential(BasicBlock(3, 6)), (1, 1), (1, 1)),
        (nn.Sequential(BasicBlock(6, 6, stride=2)), (2, 1), (1, 1)),
        (nn.Sequential(Bottleneck(8, 2)), (1, 1), (1, 1)),
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


def test_whole_channels_are_dropped_before_the_first_block_and_after_every_one() -> None:
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


@pytest.mark.parametrize(
    ("align_corners", "row"),
    [
        (False, [0.0, 1.0, 3.0, 4.0]),  # centres of the new cells lie at -1/4, 1/4, 3/4, 5/4
        (True, [0.0, 4 / 3, 8 / 3, 4.0]),  # at 0, 1/3, 2/3, 1
    ],
)
def test_up_block_by_hand(align_corners: bool, row: list[float]) -> None:
    block = UpBlock(1, 1, align_corners=align_corners).eval()
    state = block.state_dict()
    # The middle tap alone, doubled, plus 1; normalised with mean 4 and deviation 2.
    state["conv.0.weight"].zero_()[0, 0, 1, 1] = 2.0
    state["conv.0.bias"].fill_(1.0)
    state["conv.1.running_mean"].fill_(4.0)
    state["conv.1.running_var"].fill_(4.0 - 1e-5)
    state["conv.2.weight"].fill_(0.5)
    found = block(torch.tensor([0.0, 4.0]).view(1, 1, 1, 2))
    normalised = [(2 * value + 1 - 4) / 2 for value in row]
    expected = [value if value > 0 else 0.5 * value for value in normalised]
    torch.testing.assert_close(found[0, 0], torch.tensor([expected, expected]))


# ---- discriminator -------------------------------------------------------------------------------


@pytest.mark.parametrize(("in_channels", "expected"), [(13, 2_774_977), (14, 2_776_001)])
def test_critic_has_the_released_parameters(in_channels: int, expected: int) -> None:
    with torch.device("meta"):
        net = nano("critic", in_channels=in_channels, base_width=64)
    assert count(net) == expected
    layers = {key.split(".")[0] for key in net.state_dict()}
    assert layers == {"conv1", "conv2", "conv3", "conv4", "classifier"}


def test_critic_shapes() -> None:
    for upsample, size, verdicts in (
        (False, (320, 640), (10, 20)),
        (True, (320, 640), (320, 640)),
        (False, (120, 160), (3, 5)),
        (True, (120, 160), (96, 160)),
        (False, (32, 63), (1, 1)),
    ):
        with torch.device("meta"):
            found = nano("critic", upsample=upsample)(torch.empty(2, 2, *size))
        assert found.shape[2:] == verdicts
    with pytest.raises(InputError, match="at least 32 x 32, got 31 x 64"):
        nano("critic")(torch.zeros(1, 2, 31, 64))
    with pytest.raises(ValueError, match="C=2"):
        nano("critic")(torch.zeros(1, 3, 32, 32))


@pytest.mark.parametrize("align_corners", [False, True])
@torch.no_grad()
def test_critic_verdicts_are_enlarged_between_their_centres(align_corners: bool) -> None:
    small, large = nano("critic"), nano("critic", upsample=True, align_corners=align_corners)
    large.load_state_dict(randomise(small))
    x, rows = normal(1, 2, 64, 32), torch.arange(64)
    top, bottom = small(x)[0, 0, :, 0]
    share = rows / 63 if align_corners else ((rows + 0.5) / 32 - 0.5).clamp(0, 1)
    expected = top + share * (bottom - top)
    torch.testing.assert_close(large(x)[0, 0], expected[:, None].expand(64, 32))
