from __future__ import annotations

import colorsys
from typing import Any

import numpy as np
import pytest

from rgbt.transforms.crm import scale_and_truncate, scale_saturation, shift_hue
from tests.transforms.recipes import crm

BLACK = np.zeros((2, 2), np.uint8)


def flat(red: int, green: int, blue: int, dtype: Any = np.uint8) -> np.ndarray:
    return np.full((2, 2, 3), (red, green, blue), dtype)


@pytest.mark.parametrize("dtype", [np.uint8, np.float32])
def test_scale_and_truncate_by_hand(dtype: Any) -> None:
    image = np.array([[0, 100, 101, 200]], dtype)
    found = scale_and_truncate(image, 1.5)
    assert found.dtype == np.uint8
    assert found.tolist() == [[0, 150, 151, 255]]  # 151.5 is truncated, 300 clipped
    assert scale_and_truncate(image, offset=-100.5).tolist() == [[0, 0, 0, 99]]


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


def test_hue_by_hand() -> None:
    # Red (hue 0) plus 15 steps = 30 degrees: half way to yellow.
    np.testing.assert_allclose(shift_hue(flat(240, 0, 0), 15)[0, 0], (240, 120, 0), atol=1)
    # Red minus 30 steps = 300 degrees: magenta; the hue is a circle.
    np.testing.assert_allclose(shift_hue(flat(240, 0, 0), -30)[0, 0], (240, 0, 240), atol=1)
    # Of float images in degrees: red + 15 is 15 degrees; blue, 240 degrees, folds to 60, yellow.
    red, blue = flat(240, 0, 0, np.float32), flat(0, 0, 240, np.float32)
    np.testing.assert_allclose(shift_hue(red, 15)[0, 0], (240, 60, 0), atol=1e-3)
    np.testing.assert_allclose(shift_hue(blue, 0)[0, 0], (240, 240, 0), atol=1e-3)


def test_intended_stays_uint8_and_released_may_turn_grey() -> None:
    """Grey needs: no brightness (1/2), saturation (1/2), and no contrast before it (3/4)."""
    rng = np.random.default_rng(0)
    images = [crm().coloured(flat(200, 120, 100, np.float32), BLACK, rng)[0] for _ in range(3000)]
    grey = np.mean([np.ptp(image[0, 0]) == 0 for image in images])
    assert abs(grey - 3 / 16) < 0.03
    images = [crm().coloured(flat(200, 120, 100), BLACK, rng)[0] for _ in range(1000)]
    assert all(image.dtype == np.uint8 for image in images)
    assert not any(np.ptp(image[0, 0]) == 0 for image in images)


def test_draws_have_their_ranges_and_odds() -> None:
    """Each alone: saturation and hue leave a mid grey as it is, nothing lifts thermal's black."""
    rng, grey = np.random.default_rng(2), flat(100, 100, 100)
    pair = np.array([[0, 100]], np.uint8)
    same = crm(colour_probability=0.0).coloured(grey, pair, rng)
    assert (same[0].tolist(), same[1].tolist()) == (grey.tolist(), pair.tolist())
    still: dict[str, Any] = {"colour_probability": 1.0, "flip_probability": 0.0}
    still |= {"brightness_delta": 0.0}
    still |= {"contrast_range": (1, 1), "saturation_range": (1, 1), "hue_delta": 0}
    for changes, expected in (
        ({"brightness_delta": 32.0}, (68, 131)),
        ({"contrast_range": (0.5, 1.5)}, (50, 149)),
    ):
        only = crm(**{**still, **changes})
        values = [int(only.coloured(grey, pair, rng)[0][0, 0, 0]) for _ in range(500)]
        assert (min(values), max(values)) == pytest.approx(expected, abs=1)
    thermal = np.array([crm().coloured(grey, pair, rng)[1][0] for _ in range(1000)])
    assert (thermal[:, 0] == 0).all()
    assert (thermal[:, 1].min(), thermal[:, 1].max()) == pytest.approx((50, 149), abs=1.5)
    assert abs((thermal[:, 1] == 100).mean() - 0.5) < 0.08
    # Hues of both ends, as shifts of red.
    hue, red = crm(**{**still, "hue_delta": 2}), flat(240, 0, 0)
    found = {tuple(hue.coloured(red, pair, rng)[0][0, 0].tolist()) for _ in range(200)}
    assert found == {tuple(shift_hue(red, by)[0, 0].tolist()) for by in (-2, -1, 0, 1, 2)}


def test_every_range_is_its_own_and_is_filled() -> None:
    """S = 1 - 50 / 100 is scaled by its own range, the levels 100 of RGB and thermal by theirs."""
    ranges = {
        "contrast_range": (1.2, 1.6),
        "saturation_range": (0.4, 0.8),
        "thermal_contrast_range": (2.0, 2.4),
    }
    transform = crm(**ranges, colour_probability=1.0, brightness_delta=0.0, hue_delta=0)
    rng, thermal = np.random.default_rng(3), np.full((2, 2), 100, np.uint8)
    pairs = [transform.coloured(flat(100, 50, 50), thermal, rng) for _ in range(300)]
    brightest, darkest = np.array([(rgb.max(), rgb.min()) for rgb, _ in pairs], float).T
    found = {
        "contrast_range": brightest / 100,
        "saturation_range": (1 - darkest / brightest) / 0.5,
        "thermal_contrast_range": np.array([grey.max() for _, grey in pairs]) / 100,
    }
    for name, factors in found.items():  # to a step of a grey level or of OpenCV's saturation
        assert (factors.min(), factors.max()) == pytest.approx(ranges[name], abs=0.035), name


def test_pixels_do_not_depend_on_place_in_row() -> None:
    """OpenCV rounds the last pixels of a row of HSV in another way than those before them."""
    pixels = np.random.default_rng(5).integers(0, 256, (1, 131, 3), dtype=np.uint8)
    whole = shift_hue(pixels, 7)
    for end in (1, 31, 64, 100):
        np.testing.assert_array_equal(shift_hue(pixels[:, :end].copy(), 7), whole[:, :end])
