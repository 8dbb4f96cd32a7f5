"""Normalisation per release, hidden pixels, padding, views."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.models.inputs import Inputs, expand_cells
from rgbt.types import MaskPair
from tests.models.golden import compose


def inputs(**changes: Any) -> Inputs:
    values: dict[str, Any] = {
        **{"rgb_order": "rgb", "rgb_mean": (0.0, 51.0, 102.0), "rgb_std": (255.0, 51.0, 25.5)},
        **{"thermal_mean": (0.0,), "thermal_std": (255.0,), "thermal_scale": "fixed"},
    }
    return Inputs(**{**values, **changes})


def ones(height: int = 32, width: int = 32, count: int = 1) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.ones(count, 3, height, width), torch.full((count, 1, height, width), 0.5)


def test_channels_are_shifted_and_scaled_in_grey_levels() -> None:
    rgb, thermal = inputs()(*ones())
    # By hand: 255 grey levels over 255; 204 over 51; 153 over 25.5.
    assert rgb[0, :, 0, 0].tolist() == pytest.approx([1.0, 4.0, 6.0])
    assert thermal.shape == (1, 1, 32, 32)
    assert thermal.unique().item() == pytest.approx(0.5)
    three = inputs(thermal_mean=(0.0, 127.5, 0.0), thermal_std=(255.0, 255.0, 127.5))
    assert three.thermal_channels == 3
    assert three(*ones())[1][0, :, 0, 0].tolist() == pytest.approx([0.5, 0.0, 1.0])


def test_bgr_swaps_the_images_channels_and_not_the_means() -> None:
    red = torch.tensor([1.0, 0.0, 0.0]).view(1, 3, 1, 1).expand(1, 3, 32, 32)
    rgb, _ = inputs(rgb_order="bgr")(red, ones()[1])
    assert rgb[0, :, 0, 0].tolist() == pytest.approx([0.0, -1.0, 6.0])


@pytest.mark.parametrize(("channel", "luma"), [(0, 0.299), (1, 0.587), (2, 0.114)])
def test_gray_is_the_luma_in_all_three_channels(channel: int, luma: float) -> None:
    """ITU-R BT.601; the means are those of `inputs`."""
    image = torch.zeros(1, 3, 32, 32)
    image[:, channel] = 1
    rgb, _ = inputs(rgb_order="gray")(image, ones()[1])
    expected = [255 * luma / 255, (255 * luma - 51) / 51, (255 * luma - 102) / 25.5]
    assert rgb[0, :, 5, 7].tolist() == pytest.approx(expected, rel=1e-5)


def test_every_thermal_image_is_divided_by_its_own_maximum() -> None:
    rgb, thermal = ones(count=3)
    thermal[0, 0, 0, 0], thermal[1], thermal[2] = 0.25, 0.125, 0.0
    _, scaled = inputs(thermal_scale="image_max")(rgb, thermal)
    assert [each.unique().tolist() for each in scaled] == [[0.5, 1.0], [1.0], [0.0]]


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


@pytest.mark.parametrize("change", [{"thermal_mean": (0.0,) * 2}, {"thermal_std": (1.0,) * 3}])
def test_settings_that_do_not_fit_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InputError, match="model.inputs"):
        inputs(**change)


@pytest.mark.parametrize(
    ("option", "rgb", "thermal"),
    [
        # White and mid-grey thermal in each release's convention, by hand.
        ("crm", [2.248908, 2.428571, 2.640000], [(127.5 - 127) / 60]),
        ("unit", [1.0] * 3, [0.5]),
        ("half", [1.0] * 3, [0.0]),
        ("half_three", [1.0] * 3, [0.0] * 3),
        ("gray_three", [(1 - 0.369) / 0.321] * 3, [0.0] * 3),
        ("temporal", [1.0] * 3, [1.0] * 3),
        ("cmx", [2.248908, 2.428571, 2.640000], [0.065502, 0.196429, 0.417778]),
        ("cmx_released", [2.248908, 2.428571, 2.640000], [0.065502, 0.196429, 0.417778]),
        ("caffe", [255 - 104.007, 255 - 116.669, 255 - 122.679],
         [127.5 - 104.007, 127.5 - 116.669, 127.5 - 122.679]),
    ],
)  # fmt: skip
def test_conventions_of_the_releases(option: str, rgb: list[float], thermal: list[float]) -> None:
    found = build(compose(f"model/inputs={option}").model.inputs)(*ones())
    for image, expected in zip(found, (rgb, thermal), strict=True):
        assert image[0, :, 0, 0].tolist() == pytest.approx(expected, rel=1e-6, abs=1e-5)
