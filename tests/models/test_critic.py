"""The critic: sizes, verdicts by plain loops, parameter counts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from rgbt.checks import InputError
from rgbt.models.critic import Critic
from tests.models.plain import generator, randomise


def critic(**changes: Any) -> Critic:
    settings = {"in_channels": 2, "base_width": 2, "upsample": False, "align_corners": False}
    return Critic(**{**settings, **changes})


@pytest.mark.parametrize(("in_channels", "count"), [(13, 2_774_977), (14, 2_776_001)])
def test_parameter_count(in_channels: int, count: int) -> None:
    with torch.device("meta"):
        net = critic(in_channels=in_channels, base_width=64)
    assert sum(parameter.numel() for parameter in net.parameters()) == count
    layers = {key.split(".")[0] for key in net.state_dict()}
    assert layers == {"conv1", "conv2", "conv3", "conv4", "classifier"}


@pytest.mark.parametrize(
    ("upsample", "size", "verdicts"),
    [
        (False, (320, 640), (10, 20)),
        (True, (320, 640), (320, 640)),
        (False, (120, 160), (3, 5)),
        (True, (120, 160), (96, 160)),
        (False, (32, 63), (1, 1)),
    ],
)
def test_shapes(upsample: bool, size: tuple[int, int], verdicts: tuple[int, int]) -> None:
    with torch.device("meta"):
        found = critic(upsample=upsample)(torch.empty(2, 2, *size))
    assert found.shape == (2, 1, *verdicts)


def test_refusals() -> None:
    with pytest.raises(InputError, match="critic.align_corners"):
        critic(align_corners=True)
    with pytest.raises(InputError, match="at least 32 x 32, got 31 x 64"):
        critic()(torch.zeros(1, 2, 31, 64))
    with pytest.raises(ValueError, match="C=2"):
        critic()(torch.zeros(1, 3, 32, 32))


def convolved(x: np.ndarray, weight: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """4x4, stride 2, padding 1, one output pixel after the other."""
    padded = np.pad(x, ((0, 0), (1, 1), (1, 1)))
    height, width = x.shape[1] // 2, x.shape[2] // 2
    result = np.empty((len(weight), height, width))
    for row in range(height):
        for column in range(width):
            patch = padded[:, 2 * row : 2 * row + 4, 2 * column : 2 * column + 4]
            result[:, row, column] = (weight * patch).sum((1, 2, 3)) + bias
    return result


def test_verdicts_by_plain_loops() -> None:
    net = critic()
    state = {key: value.numpy() for key, value in randomise(net).items()}
    x = torch.randn(1, 2, 64, 32, generator=generator())
    y = x[0].double().numpy()
    for name in ("conv1", "conv2", "conv3", "conv4"):
        y = convolved(y, state[f"{name}.weight"], state[f"{name}.bias"])
        y = np.where(y > 0, y, 0.2 * y)
    y = convolved(y, state["classifier.weight"], state["classifier.bias"])
    assert y.shape == (1, 2, 1)
    torch.testing.assert_close(net(x)[0].detach(), torch.from_numpy(y).float())


@pytest.mark.parametrize("align_corners", [False, True])
def test_verdicts_are_enlarged_between_their_centres(align_corners: bool) -> None:
    small, large = critic(), critic(upsample=True, align_corners=align_corners)
    large.load_state_dict(randomise(small))
    x = torch.randn(1, 2, 64, 32, generator=generator())
    with torch.no_grad():
        top, bottom = small(x)[0, 0, :, 0]
        found = large(x)[0, 0]
    rows = torch.arange(64)
    share = rows / 63 if align_corners else ((rows + 0.5) / 32 - 0.5).clamp(0, 1)
    expected = top + share * (bottom - top)
    torch.testing.assert_close(found, expected[:, None].expand(64, 32))


def test_gradient_reaches_the_map_and_every_weight() -> None:
    net = critic(upsample=True)
    x = torch.randn(2, 2, 64, 64, generator=generator(), requires_grad=True)
    net(x).square().mean().backward()
    assert x.grad is not None
    assert (x.grad != 0).all(1).float().mean() > 0.9
    assert all(parameter.grad.abs().sum() > 0 for parameter in net.parameters())
