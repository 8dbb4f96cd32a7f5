"""Strong augmentation: every change by hand, what stays, and draws that are replayed."""

from __future__ import annotations

import colorsys

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.randomness import torch_generator
from rgbt.transforms import strong
from rgbt.transforms.strong import StrongAugmentation, blurred, jittered


def augmentation(jitter: float, blur: float) -> StrongAugmentation:
    chances = {"jitter_probability": jitter, "blur_probability": blur}
    return StrongAugmentation(**chances, jitter_strength=0.2, blur_sigma=(0.15, 1.15))


def images() -> tuple[Tensor, Tensor]:
    drawn = torch.rand(3, 4, 12, 16, generator=torch_generator(0, "images"))
    return drawn[:, :3], drawn[:, 3:]


def pixel(*rgb: float) -> Tensor:
    return torch.tensor(rgb).view(1, 3, 1, 1)


def by(value: float) -> Tensor:
    return torch.full((1, 1, 1, 1), value)


def test_changes_of_one_pixel() -> None:
    one = pixel(0.2, 0.4, 0.9)
    torch.testing.assert_close(jittered(one, "brightness", by(0.2)), pixel(0.4, 0.6, 1.0))
    torch.testing.assert_close(jittered(one, "contrast", by(-0.5)), pixel(0.1, 0.2, 0.45))
    for change, index, factor in (("saturation", 1, 0.8), ("hue", 0, None)):
        hsv = list(colorsys.rgb_to_hsv(0.2, 0.4, 0.9))
        hsv[index] = hsv[index] * factor if factor else (hsv[index] + 0.2) % 1
        expected = pixel(*colorsys.hsv_to_rgb(*hsv))
        found = jittered(one, change, by(-0.2 if factor else 0.2))
        # Hue in steps of two degrees, the rest in 255 steps.
        torch.testing.assert_close(found, expected, atol=0.03, rtol=0)


def test_levels_saturation_and_hue_are_rounded() -> None:
    """Level 100.7 is 101; S = 0.9 * 204 = 183.6 is 184, thus 220 (1 - S / 255) = 61.25; a hue of
    5.67 steps is 6, thus 12 degrees.
    """
    for before, change, value, after in (
        ((100.7, 100.7, 100.7), "saturation", 0.0, (101.0, 101.0, 101.0)),
        ((220.0, 44.0, 44.0), "saturation", -0.1, (220.0, 61.0, 61.0)),
        ((255.0, 0.0, 0.0), "hue", 5.67 / 180, (255.0, 255 * 12 / 60, 0.0)),
    ):
        found = jittered(pixel(*before) / 255, change, by(value))
        torch.testing.assert_close(255 * found, pixel(*after), atol=0.01, rtol=0)


def test_blur_is_the_gaussian_of_each_image() -> None:
    points = torch.zeros(2, 1, 15, 15)
    points[:, 0, 7, 7] = 1.0
    sigma = torch.tensor([0.5, 1.1])
    found = blurred(points, sigma, 1.15)
    for image, s in zip(found[:, 0], sigma.tolist(), strict=True):
        axis = torch.exp(-((torch.arange(15.0) - 7) ** 2) / (2 * s * s))
        axis[(torch.arange(15) - 7).abs() > 5] = 0
        axis = axis / axis.sum()
        torch.testing.assert_close(image, axis[:, None] * axis[None], atol=1e-6, rtol=0)
    flat = torch.full((2, 3, 4, 4), 0.7)
    torch.testing.assert_close(blurred(flat, sigma, 1.15), flat)


def test_probabilities() -> None:
    rgb, thermal = images()

    def found(jitter: float, blur: float, number: int = 0) -> tuple[Tensor, Tensor]:
        return augmentation(jitter, blur)(rgb, thermal, torch_generator(0, "a", number))

    same = found(0.0, 0.0)
    assert torch.equal(same[0], rgb)
    assert torch.equal(same[1], thermal)
    shares = {"jitter": 0, "blur": 0}
    for number in range(100):
        shares["jitter"] += not torch.equal(found(0.8, 0.0, number)[1], thermal)
        shares["blur"] += not torch.equal(found(0.0, 0.5, number)[1], thermal)
    # Standard errors 4 and 5.
    assert shares == pytest.approx({"jitter": 80, "blur": 50}, abs=16)


def test_thermal_has_its_own_draws_and_one_channel() -> None:
    """Brightness and contrast are linear before the clip: thermal = a x + b for every image."""
    rgb, thermal = images()
    found = augmentation(1.0, 0.0)(rgb, 0.3 + 0.2 * thermal, torch_generator(0, "a"))[1]
    assert found.shape == thermal.shape
    slopes = []
    for before, after in zip(0.3 + 0.2 * thermal, found, strict=True):
        x, y = before.flatten(), after.flatten()
        slope = (y[1] - y[0]) / (x[1] - x[0])
        torch.testing.assert_close(y, y[0] + slope * (x - x[0]), atol=1e-5, rtol=0)
        slopes.append(round(slope.item(), 3))
    assert len(set(slopes)) == 3
    assert all(0.8 <= slope <= 1.2 for slope in slopes)


def test_draws_fill_their_ranges_and_are_independent(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 2000 draws in a range, the ends lie within a hundredth of it."""
    drawn: dict[tuple[int, str], np.ndarray] = {}

    def jitter(images: Tensor, change: str, by: Tensor) -> Tensor:
        drawn[images.shape[1], change] = by.flatten().numpy()
        return images

    def blur(images: Tensor, sigma: Tensor, largest: float) -> Tensor:
        drawn[images.shape[1], "sigma"] = sigma.numpy()
        assert largest == 1.15
        return images

    monkeypatch.setattr(strong, "jittered", jitter)
    monkeypatch.setattr(strong, "blurred", blur)
    shown = torch.zeros(2000, 3, 1, 1), torch.zeros(2000, 1, 1, 1)
    augmentation(1.0, 1.0)(*shown, torch_generator(0, "a"))
    # Both images have the same sigma; everything else is drawn alone.
    np.testing.assert_array_equal(drawn.pop((1, "sigma")), drawn[3, "sigma"])
    changes = [(3, name) for name in ("brightness", "contrast", "saturation", "hue")]
    changes += [(1, "brightness"), (1, "contrast"), (3, "sigma")]
    assert set(drawn) == set(changes)
    for change, values in drawn.items():
        low, high = (0.15, 1.15) if change[1] == "sigma" else (-0.2, 0.2)
        hundredth = 0.01 * (high - low)
        assert low <= values.min() < low + hundredth, change
        assert high - hundredth < values.max() <= high, change
        # The standard error of the mean is 0.0065 of the range.
        assert values.mean() == pytest.approx((low + high) / 2, abs=0.03 * (high - low)), change
    assert abs(np.corrcoef([*drawn.values()]) - np.eye(7)).max() < 0.1


def test_draws_are_replayed_and_their_number_is_fixed() -> None:
    rgb, thermal = images()
    ends = []
    for jitter, blur in ((1.0, 1.0), (0.0, 0.0), (1.0, 1.0)):
        generator = torch_generator(0, "a")
        ends.append((augmentation(jitter, blur)(rgb, thermal, generator), generator.get_state()))
    first, second, third = ends
    assert torch.equal(first[0][0], third[0][0])
    assert not torch.equal(first[0][0], second[0][0])
    assert torch.equal(first[1], second[1])
