from __future__ import annotations

import math

import numpy as np
import pytest

from analysis.statistics.measure import (
    ESTIMATORS,
    HAAR_BINS,
    ImageMeter,
    grouped_median,
)
from rgbt.metrics.metric import Regions
from tests.analysis.statistics.scenes import random_sample

IMMERKAER, MAD, STD = range(2, 5)


def regions_map(partition: str, regions: int, hw: tuple[int, int]) -> np.ndarray:
    aspect = "image" if partition == "ring" else None
    chosen = Regions(partition=partition, regions=regions, aspect=aspect, absent="released")
    return chosen.map(hw)


def reference(image: np.ndarray, region_map: np.ndarray, eight: bool) -> list[list[float]]:
    """Pixel by pixel: Laplacian variance, mean, Immerkaer, wavelet, standard deviation."""
    height, width = image.shape
    wide = np.pad(image.astype(float), 1, mode="reflect")
    found: dict[int, list[list[float]]] = {}
    for r in range(int(region_map.max()) + 1):
        found[r] = [[], [], [], []]
    for y in range(height):
        for x in range(width):
            window = wide[y : y + 3, x : x + 3]
            cross = window[0, 1] + window[1, 0] + window[1, 2] + window[2, 1] - 4 * window[1, 1]
            laplacian, pixels, responses, haar = found[int(region_map[y, x])]
            laplacian.append(window.sum() - 9 * window[1, 1] if eight else cross)
            pixels.append(window[1, 1])
            if 0 < y < height - 1 and 0 < x < width - 1:
                corners = window[0, 0] + window[0, 2] + window[2, 0] + window[2, 2]
                edges = window[0, 1] + window[1, 0] + window[1, 2] + window[2, 1]
                responses.append(abs(corners - 2 * edges + 4 * window[1, 1]))
            if y % 2 == x % 2 == 0 and y + 1 < height and x + 1 < width:
                a, b, c, d = window[1, 1], window[1, 2], window[2, 1], window[2, 2]
                haar.append(abs(a - b - c + d))
    rows = []
    for laplacian, pixels, responses, haar in found.values():
        histogram = np.bincount(np.array(haar, int), minlength=HAAR_BINS)[None]
        rows.append(
            [
                float(np.var(laplacian)),
                float(np.mean(pixels)),
                math.sqrt(math.pi / 2) / 6 * float(np.mean(responses)),
                float(grouped_median(histogram)[0]) / 2 / 0.6744897501960817,
                float(np.std(pixels)),
            ]
        )
    return [list(column) for column in zip(*rows)]


@pytest.mark.parametrize("kernel", ["four", "eight"])
@pytest.mark.parametrize(
    ("partition", "regions"), [("ring", 3), ("vertical", 4), ("horizontal", 2)]
)
@pytest.mark.parametrize("hw", [(24, 32), (23, 31)])
def test_measure_against_a_loop_over_pixels(partition, regions, hw, kernel) -> None:
    region_map = regions_map(partition, regions, hw)
    image = random_sample("a", hw, np.random.default_rng(1)).thermal
    found = ImageMeter(region_map, 9, kernel).measure(image)
    expected = reference(image, region_map, kernel == "eight")
    for ours, wanted in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, wanted, rtol=1e-12)


@pytest.mark.parametrize("shape", ["flat", "gradient"])
def test_planted_noise_is_found_in_every_region(shape: str) -> None:
    hw = (240, 320)
    region_map = regions_map("ring", 3, hw)
    sigmas = np.array([8.0, 4.0, 2.0])
    rng = np.random.default_rng(0)
    clean = np.full(hw, 120.0)
    if shape == "gradient":
        clean += np.linspace(-40, 40, hw[1]) + np.linspace(-20, 20, hw[0])[:, None]
    noisy = clean + rng.normal(size=hw) * sigmas[region_map]
    found = ImageMeter(region_map, 9).measure(np.clip(noisy.round(), 0, 255).astype(np.uint8))
    np.testing.assert_allclose(found[IMMERKAER], sigmas, rtol=0.04)
    np.testing.assert_allclose(found[MAD], sigmas, rtol=0.04)
    if shape == "flat":
        np.testing.assert_allclose(found[STD], sigmas, rtol=0.04)
    else:
        assert (found[STD] > 10).all(), "the gradient counts as noise"


def test_grouped_median_by_hand() -> None:
    # 4 zeros in [0, .5), 8 ones in [.5, 1.5): half of 12 is 6, two of eight into the second bin.
    histogram = np.zeros((3, 5), np.int64)
    histogram[0, :2] = 4, 8
    histogram[1, 3] = 6  # all threes: the middle of [2.5, 3.5)
    found = grouped_median(histogram)
    np.testing.assert_allclose(found[:2], [0.5 + 2 / 8, 3.0])
    assert np.isnan(found[2])


def test_largest_values_do_not_overflow() -> None:
    """A checkerboard of 0 and 255 has the largest Laplacian there is, over 300 rows."""
    image = (np.indices((300, 300)).sum(0) % 2 * 255).astype(np.uint8)
    found = ImageMeter(np.zeros((300, 300), np.uint8), 9, "four").measure(image)
    assert found[0][0] == pytest.approx(1020.0**2)


def test_labels_are_counted_by_region() -> None:
    region_map = regions_map("ring", 3, (24, 32))
    sample = random_sample("a", (24, 32), np.random.default_rng(3))
    labels, ignored = ImageMeter(region_map, 9).count_labels(sample.label)
    for r in range(3):
        inside = sample.label[region_map == r]
        assert labels[r].tolist() == [int((inside == k).sum()) for k in range(9)]
        assert ignored[r] == (inside == 255).sum()


def test_a_region_without_a_window_has_no_noise() -> None:
    region_map = np.zeros((4, 4), np.uint8)
    region_map[3, 3] = 1  # neither inside the border nor the first pixel of a block
    found = ImageMeter(region_map, 9).measure(np.zeros((4, 4), np.uint8))
    assert np.isnan(found[IMMERKAER][1])
    assert np.isnan(found[MAD][1])
    assert len(found) == 2 + len(ESTIMATORS)
