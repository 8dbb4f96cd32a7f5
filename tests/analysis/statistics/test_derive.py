from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from analysis.statistics import derive
from analysis.statistics.collect import MeasurementSettings, collect
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions
from rgbt.types import Sample
from tests.analysis.statistics.scenes import InMemory, made, random_sample

HW = (60, 80)
RINGS = Regions(partition="ring", regions=4, aspect="image", absent="released")


def planted(shares: tuple[float, ...], images: int, rng: np.random.Generator) -> InMemory:
    """Images whose ring r holds class 1 in a share of its pixels, drawn exactly."""
    region_map = RINGS.map(HW)
    samples = []
    for n in range(images):
        label = np.zeros(HW, np.uint8)
        for r, share in enumerate(shares):
            inside = np.flatnonzero(region_map == r)
            chosen = rng.permutation(inside)[: round(share * len(inside))]
            label.ravel()[chosen] = 1
        blank = np.zeros((*HW, 3), np.uint8)
        samples.append(Sample(blank, blank[..., 0], label, f"{n:05d}D"))
    return InMemory(samples)


def test_planted_occupancy_is_found() -> None:
    shares = (0.5, 0.3, 0.2, 0.05)
    stats = collect(
        planted(shares, 6, np.random.default_rng(0)), "train", MeasurementSettings(regions=RINGS)
    )
    np.testing.assert_allclose(derive.region_occupancy(stats), shares, atol=1e-3)
    map_ = derive.occupancy_map(stats)
    by_region = [map_[stats.region_map == r].mean() for r in range(4)]
    np.testing.assert_allclose(derive.region_occupancy(stats), by_region, rtol=1e-12)
    np.testing.assert_allclose(
        derive.normalised(derive.class_region_occupancy(stats))[1], [1, 0.6, 0.4, 0.1], atol=2e-3
    )
    assert np.isnan(derive.normalised(derive.class_region_occupancy(stats))[2]).all()


ROAD_FIRST = ("road", "car", "other", "void")


def test_occupancy_leaves_out_the_stated_background() -> None:
    labels = np.zeros((2, 2, 4), np.int64)
    labels[:, 0] = 60, 10, 20, 10  # 70 of 100 pixels of region 1 are no background
    labels[:, 1] = 10, 0, 5, 5  # 10 of 20 of region 2
    stats = made(
        images=2, regions=2, classes=ROAD_FIRST, background=("other", "void"), labels=labels
    )
    np.testing.assert_allclose(derive.region_occupancy(stats), [0.7, 0.5])
    # Without background: 6/7 and 1/7, then road alone.
    bits = -(6 / 7 * math.log2(6 / 7) + 1 / 7 * math.log2(1 / 7))
    np.testing.assert_allclose(derive.label_entropy(stats, background=False), [bits, 0])
    occupied = np.zeros((1, 4, 2, 4), np.int32)
    occupied[0, :, 0, 0] = 1, 2, 4, 1  # of eight images three
    stats = made(
        images=8,
        regions=2,
        classes=ROAD_FIRST,
        background=("other", "void"),
        night=False,
    )
    found = derive.occupancy_map(replace(stats, occupied=occupied))
    assert found[0, 0] == pytest.approx(3 / 8)
    assert np.isnan(found[1:]).all()


@pytest.mark.parametrize("occupancy", [derive.region_occupancy, derive.occupancy_map])
def test_without_background_there_is_no_occupancy(occupancy) -> None:
    with pytest.raises(InputError, match="no class of made is stated as background"):
        occupancy(made(classes=ROAD_FIRST, background=()))


def test_an_ignored_pixel_is_no_background() -> None:
    """2 x 2 pixels, three images: at (0, 0) one is ignored and one of the other two is class 1."""
    labels = [[[255, 0], [1, 255]], [[1, 0], [1, 255]], [[0, 2], [0, 255]]]
    blank = np.zeros((2, 2, 3), np.uint8)
    samples = [
        Sample(blank, blank[..., 0], np.array(label, np.uint8), f"{n}D")
        for n, label in enumerate(labels)
    ]
    whole = Regions(partition="vertical", regions=2, aspect=None, absent="released")
    stats = collect(InMemory(samples), "train", MeasurementSettings(regions=whole))
    map_ = derive.occupancy_map(stats)
    np.testing.assert_allclose(map_[:, 0], [1 / 2, 2 / 3])
    assert map_[0, 1] == pytest.approx(1 / 3)
    assert np.isnan(map_[1, 1])
    # Left column: 5 valid pixels, 3 of class 1. Right column: 3 valid pixels, 1 of class 2.
    np.testing.assert_allclose(derive.region_occupancy(stats), [3 / 5, 1 / 3])
    by_class = derive.class_region_occupancy(stats)
    np.testing.assert_allclose(by_class[1], [3 / 5, 0])
    np.testing.assert_allclose(by_class[2], [0, 1 / 3])
    assert stats.ignored.sum(0).tolist() == [1, 3]


def test_entropy_by_hand() -> None:
    labels = np.zeros((2, 3, 4), np.int64)
    labels[0, 0] = 2, 1, 1, 0  # shares 1/2, 1/4, 1/4: 1.5 bits; without background 1 bit
    labels[1, 1] = 0, 4, 4, 8  # the second image: 1.5 bits, either way
    labels[1, 0] = 2, 1, 1, 0
    labels[0, 2] = 9, 0, 0, 0  # background alone: 0 bits, and nothing without it
    stats = made(images=2, labels=labels)
    np.testing.assert_allclose(derive.label_entropy(stats), [1.5, 1.5, 0])
    found = derive.label_entropy(stats, background=False)
    np.testing.assert_allclose(found[:2], [1, 1.5])
    assert math.isnan(found[2])


def test_averages_of_ratios_by_hand() -> None:
    """Day: mean 100 over noise 2; night: mean 20 over noise 4. Thermal as given."""
    mean = np.full((2, 2, 3), 100.0)
    noise = np.full((2, 2, 3), 2.0)
    mean[1, 0], noise[1, 0] = 20, 4
    stats = made(images=2, mean=mean, noise=noise)
    pooled = derive.region_snr(stats, "rgb")
    images = derive.region_snr(stats, "rgb", average="images")
    np.testing.assert_allclose(pooled, 120 / 6, rtol=1e-6)
    np.testing.assert_allclose(images, (50 + 5) / 2, rtol=1e-6)
    np.testing.assert_allclose(derive.region_snr(stats, "rgb", "night"), 5, rtol=1e-6)
    np.testing.assert_allclose(derive.region_snr(stats, "thermal"), 50, rtol=1e-6)
    np.testing.assert_allclose(derive.region_noise(stats, "rgb"), 3)


def test_laplacian_is_the_mean_over_images() -> None:
    laplacian = np.zeros((4, 2, 3))
    laplacian[:, 0, 1] = 1, 3, 5, 11
    stats = made(images=4, laplacian=laplacian)
    assert derive.region_laplacian(stats, "rgb").tolist() == [0, 5, 0]
    assert derive.region_laplacian(stats, "rgb", "day").tolist() == [0, 2, 0]
    assert derive.region_laplacian(stats, "thermal").tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda s: derive.region_laplacian(s, "depth"), "modality: 'depth' is not a valid choice"),
        (lambda s: derive.region_snr(s, "rgb", "dusk"), "part: 'dusk' is not a valid choice"),
        (
            lambda s: derive.region_snr(s, "rgb", estimator="mad"),
            "estimator: .mad. is not a valid choice",
        ),
        (lambda s: derive.region_snr(s, "rgb", average="median"), "average: 'median'"),
    ],
)
def test_unknown_words_are_refused(call, message: str) -> None:
    with pytest.raises(InputError, match=message):
        call(made())


def test_noise_of_zero_is_no_division_by_zero() -> None:
    stats = made(images=2, noise=np.zeros((2, 2, 3)))
    np.testing.assert_allclose(derive.region_snr(stats, "rgb"), 100 / derive.EPSILON)


def test_a_part_without_images_is_refused() -> None:
    dataset = InMemory([random_sample("1D", (24, 32), np.random.default_rng(0))])
    stats = collect(dataset, "train", MeasurementSettings(regions=RINGS))
    with pytest.raises(InputError, match="part=night: split 'train' of memory holds no such image"):
        derive.region_occupancy(stats, "night")
