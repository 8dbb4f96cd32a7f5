from __future__ import annotations

import colorsys
from typing import Any

import numpy as np
import pytest

from rgbt.transforms.crm import (
    ColourJitter,
    scale_and_truncate,
    scale_saturation,
    shift_hue,
)
from tests.transforms.recipes import JITTER


def jitter(**changes: Any) -> ColourJitter:
    values = {"colour_probability": 0.5, **JITTER}
    return ColourJitter(**{**values, **changes})


def flat(red: int, green: int, blue: int, dtype: Any = np.uint8) -> np.ndarray:
    return np.full((2, 2, 3), (red, green, blue), dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_scale_and_truncate_by_hand(dtype: Any) -> None:
    image = np.array([[0, 100, 101, 200]], dtype)
    found = scale_and_truncate(image, 1.5)
    assert found.dtype == np.uint8
    assert found.tolist() == [[0, 150, 151, 255]]  # 151.5 is truncated, 300 clipped
    assert scale_and_truncate(image, offset=-100.5).tolist() == [[0, 0, 0, 99]]


def test_uint8_and_float_scale_alike() -> None:
    rng = np.random.default_rng(0)
    image = rng.integers(0, 256, (16, 16, 3), dtype=np.uint8)
    for _ in range(20):
        factor, offset = rng.uniform(0.5, 1.5), rng.uniform(-32, 32)
        np.testing.assert_array_equal(
            scale_and_truncate(image, factor, offset),
            scale_and_truncate(image.astype(np.float32), factor, offset),
        )


@pytest.mark.parametrize("factor", [0.5, 0.8, 1.2, 1.5])
def test_saturation_of_uint8_is_scaled(factor: float) -> None:
    hue, saturation, value = colorsys.rgb_to_hsv(200 / 255, 120 / 255, 100 / 255)
    expected = 255 * np.array(colorsys.hsv_to_rgb(hue, min(1, saturation * factor), value))
    found = scale_saturation(flat(200, 120, 100), factor)
    assert found.dtype == np.uint8
    assert np.abs(found[0, 0] - expected).max() < 2.5  # whole steps of OpenCV's hue and saturation


def test_saturation_of_float_is_all_or_nothing() -> None:
    """S = 0.5: scaled by 1.5 it is 0.75, which truncates to 0; S = 0.8 scaled reaches 1."""
    grey = scale_saturation(flat(200, 120, 100, np.float32), 1.5)
    assert grey.dtype == np.float32
    np.testing.assert_allclose(grey, 200)
    full = scale_saturation(flat(200, 60, 40, np.float32), 1.3)
    assert full[0, 0, 2] == 0
    assert full[0, 0, 0] == 200


def test_hue_of_uint8_turns_by_two_degrees_per_step() -> None:
    # Red (hue 0) plus 15 steps = 30 degrees: half way to yellow.
    np.testing.assert_allclose(shift_hue(flat(240, 0, 0), 15)[0, 0], (240, 120, 0), atol=1)
    # Red minus 30 steps = 300 degrees: magenta; the hue is a circle.
    np.testing.assert_allclose(shift_hue(flat(240, 0, 0), -30)[0, 0], (240, 0, 240), atol=1)


def test_hue_of_float_is_folded() -> None:
    """In degrees now: red + 15 is 15 degrees; blue, 240 degrees, folds to 60, yellow."""
    red = flat(240, 0, 0, np.float32)
    np.testing.assert_allclose(shift_hue(red, 15)[0, 0], (240, 60, 0), atol=1e-3)
    blue = flat(0, 0, 240, np.float32)
    np.testing.assert_allclose(shift_hue(blue, 0)[0, 0], (240, 240, 0), atol=1e-3)


def test_intended_stays_uint8_and_released_may_turn_grey() -> None:
    """Grey needs: no brightness (1/2), saturation (1/2), and no contrast before it (3/4)."""
    rng = np.random.default_rng(0)
    images = [jitter().draw_colours(rng).rgb(flat(200, 120, 100, np.float32)) for _ in range(3000)]
    grey = np.mean([np.ptp(image[0, 0]) == 0 for image in images])
    assert abs(grey - 3 / 16) < 0.03
    rng = np.random.default_rng(0)
    images = [jitter().draw_colours(rng).rgb(flat(200, 120, 100)) for _ in range(1000)]
    assert all(image.dtype == np.uint8 for image in images)
    assert not any(np.ptp(image[0, 0]) == 0 for image in images)


def test_probability_zero_changes_nothing() -> None:
    image = np.random.default_rng(0).integers(0, 256, (4, 5, 3), dtype=np.uint8)
    off = jitter(colour_probability=0.0)
    rng = np.random.default_rng(1)
    np.testing.assert_array_equal(off.draw_colours(rng).rgb(image), image)
    np.testing.assert_array_equal(off.draw_colours(rng).thermal(image[..., 0]), image[..., 0])


def test_brightness_and_contrast_alone() -> None:
    """The published ranges, each alone, on a mid grey, which saturation and hue leave alone."""
    rng = np.random.default_rng(2)
    grey = flat(100, 100, 100)
    only_brightness = jitter(colour_probability=1.0, contrast_range=(1, 1))
    values = [int(only_brightness.draw_colours(rng).rgb(grey)[0, 0, 0]) for _ in range(500)]
    assert (min(values), max(values)) == pytest.approx((68, 131), abs=1)
    only_contrast = jitter(colour_probability=1.0, brightness_delta=0.0)
    values = [int(only_contrast.draw_colours(rng).rgb(grey)[0, 0, 0]) for _ in range(500)]
    assert (min(values), max(values)) == pytest.approx((50, 149), abs=1)


def test_thermal_gets_contrast_alone_half_of_the_time() -> None:
    rng = np.random.default_rng(3)
    image = np.array([[0, 100]], np.uint8)
    found = np.array([jitter().draw_colours(rng).thermal(image)[0] for _ in range(1000)])
    assert (found[:, 0] == 0).all()  # brightness would lift the zero
    assert 50 <= found[:, 1].min() < 52
    assert 148 < found[:, 1].max() <= 150
    assert abs((found[:, 1] == 100).mean() - 0.5) < 0.08


def test_hue_reaches_both_ends() -> None:
    draws = np.random.default_rng(4)
    found = {
        jitter(colour_probability=1.0, hue_delta=2).draw_colours(draws).hue for _ in range(200)
    }
    assert found == {-2, -1, 0, 1, 2}


def test_pixels_do_not_depend_on_their_place_in_a_row() -> None:
    """OpenCV rounds the last pixels of a row of HSV in another way than those before them."""
    pixels = np.random.default_rng(5).integers(0, 256, (1, 131, 3), dtype=np.uint8)
    whole = shift_hue(pixels, 7)
    for end in (1, 31, 64, 100):
        np.testing.assert_array_equal(shift_hue(pixels[:, :end].copy(), 7), whole[:, :end])
