"""Quantities by hand, and the blocks and intervals of a sample."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from analysis.statistics.collect import collect
from analysis.statistics.resampled import (
    EPSILON,
    ResampledSplit,
    normalised,
    occupancy_map,
    quantities,
)
from analysis.uncertainty import Resampling
from analysis.uncertainty.intervals import student
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions
from rgbt.types import Sample
from tests.analysis.statistics.scenes import InMemory, made

HW = (60, 80)
RINGS = Regions(partition="ring", regions=4, aspect="image", absent="released")
ROAD_FIRST = ("road", "car", "other", "void")
TENS = Resampling(resamples=100, blocks=10)


def test_planted_occupancy_is_found() -> None:
    """Images whose ring r holds class 1 in a share of its pixels, drawn exactly."""
    rng, region_map, samples = np.random.default_rng(0), RINGS.map(HW), []
    shares = (0.5, 0.3, 0.2, 0.05)
    for n in range(6):
        label = np.zeros(HW, np.uint8)
        for r, share in enumerate(shares):
            inside = np.flatnonzero(region_map == r)
            label.ravel()[rng.permutation(inside)[: round(share * len(inside))]] = 1
        blank = np.zeros((*HW, 3), np.uint8)
        samples.append(Sample(blank, blank[..., 0], label, f"{n:05d}D"))
    stats = collect(InMemory(samples), "train", RINGS)
    found = ResampledSplit(stats).occupancy()[0]
    np.testing.assert_allclose(found, shares, atol=1e-3)
    map_ = occupancy_map(stats)
    np.testing.assert_allclose(found, [map_[region_map == r].mean() for r in range(4)])
    relative = normalised(ResampledSplit(stats).classes()[0])
    np.testing.assert_allclose(relative[1], [1, 0.6, 0.4, 0.1], atol=2e-3)
    assert np.isnan(relative[2]).all()


def test_occupancy_leaves_out_the_stated_background() -> None:
    labels = np.zeros((2, 2, 4), np.int64)
    labels[:, 0] = 60, 10, 20, 10  # 70 of 100 pixels of region 1 are no background
    labels[:, 1] = 10, 0, 5, 5  # 10 of 20 of region 2
    plain = made(images=2, regions=2, classes=ROAD_FIRST, background=("other", "void"))
    sample = ResampledSplit(replace(plain, labels=labels))
    np.testing.assert_allclose(sample.occupancy()[0], [0.7, 0.5])
    # Without background: 6/7 and 1/7, then road alone.
    bits = -(6 / 7 * math.log2(6 / 7) + 1 / 7 * math.log2(1 / 7))
    np.testing.assert_allclose(sample.entropy(background=False)[0], [bits, 0])
    occupied = np.zeros((2, 4, 2, 4), np.int32)
    occupied[0, :, 0, 0] = 1, 2, 4, 1  # of eight images three
    found = occupancy_map(replace(plain, occupied=occupied))
    assert found[0, 0] == pytest.approx(3 / 8)
    assert np.isnan(found[1:]).all()


def test_an_ignored_pixel_is_no_background() -> None:
    """2 x 2 pixels, three images: at (0, 0) one is ignored and one of the other two is class 1."""
    labels = [[[255, 0], [1, 255]], [[1, 0], [1, 255]], [[0, 2], [0, 255]]]
    blank = np.zeros((2, 2, 3), np.uint8)
    samples = [
        Sample(blank, blank[..., 0], np.array(label, np.uint8), f"{n}D")
        for n, label in enumerate(labels)
    ]
    strips = Regions(partition="vertical", regions=2, aspect=None, absent="released")
    stats = collect(InMemory(samples), "train", strips)
    map_ = occupancy_map(stats)
    np.testing.assert_allclose(map_, [[1 / 2, 1 / 3], [2 / 3, np.nan]])
    # Left column: 5 valid pixels, 3 of class 1. Right column: 3 valid pixels, 1 of class 2.
    np.testing.assert_allclose(ResampledSplit(stats).occupancy()[0], [3 / 5, 1 / 3])
    by_class = ResampledSplit(stats).classes()[0]
    np.testing.assert_allclose(by_class[1:3], [[3 / 5, 0], [0, 1 / 3]])
    assert stats.ignored.sum(0).tolist() == [1, 3]


def test_entropy_by_hand() -> None:
    labels = np.zeros((2, 3, 4), np.int64)
    labels[0, 0] = 2, 1, 1, 0  # shares 1/2, 1/4, 1/4: 1.5 bits; without background 1 bit
    labels[1, 1] = 0, 4, 4, 8  # the second image: 1.5 bits, either way
    labels[1, 0] = 2, 1, 1, 0
    labels[0, 2] = 9, 0, 0, 0  # background alone: 0 bits, and nothing without it
    sample = ResampledSplit(made(images=2, labels=labels))
    np.testing.assert_allclose(sample.entropy()[0], [1.5, 1.5, 0])
    np.testing.assert_allclose(sample.entropy(background=False)[0], [1, 1.5, np.nan])


def test_averages_of_ratios_by_hand() -> None:
    """Day: mean 100 over noise 2; night: mean 20 over noise 4. Thermal as given."""
    mean, noise = np.full((2, 2, 3), 100.0), np.full((2, 2, 3), 2.0)
    mean[1, 0], noise[1, 0] = 20, 4
    sample = ResampledSplit(made(images=2, mean=mean, noise=noise))
    np.testing.assert_allclose(sample.snr()[0, 0], 120 / 6, rtol=1e-6)
    images = sample.snr(way=("std", "images"))
    np.testing.assert_allclose(images[0, 0], (50 + 5) / 2, rtol=1e-6)
    np.testing.assert_allclose(sample.snr("night")[0, 0], 5, rtol=1e-6)
    np.testing.assert_allclose(sample.snr()[0, 1], 50, rtol=1e-6)
    np.testing.assert_allclose(sample.noise()[0, 0], 3)
    flat = ResampledSplit(made(images=2, noise=np.zeros((2, 2, 3))))
    np.testing.assert_allclose(flat.snr(), 100 / EPSILON)  # no division by zero
    for wrong in (("mad", "pooled"), ("std", "median")):
        with pytest.raises(InputError, match="is not a valid choice"):
            ResampledSplit(made(), None, wrong)


def test_quantities_are_one_tidy_frame() -> None:
    laplacian = np.zeros((4, 2, 3))
    laplacian[:, 0, 1] = 1, 3, 5, 11
    frame = quantities(made(images=4, laplacian=laplacian))
    rows = frame[(frame["quantity"] == "laplacian") & (frame["modality"] == "rgb")]
    found = rows.pivot_table(index="part", columns="region", values="value").loc[["all", "day"]]
    assert found.to_numpy().tolist() == [[0, 5, 0], [0, 2, 0]]
    assert rows.groupby("part")["images"].first().to_dict() == {"all": 4, "day": 2, "night": 2}
    assert (frame["quantity"] == "snr").sum() == 3 * 2 * 3 * 2 * 3  # parts, ways, modalities, R
    assert frame[frame["class"] == "car"]["value"].tolist()[:6] == [0.25] * 3 + [1.0] * 3


def test_a_mean_gets_the_t_interval_of_its_blocks() -> None:
    values = np.random.default_rng(0).normal(size=100)
    sample = ResampledSplit(made(images=100, night=False), Resampling(resamples=20_000, blocks=10))
    found = sample.evidence(sample.mean(values))
    means = values.reshape(10, 10).mean(1)
    assert found.values[0] == pytest.approx(values.mean())
    assert found.error == pytest.approx(means.std(ddof=1) / math.sqrt(10), rel=0.02)
    reach = student(0.0, found.images, 0.95).high
    assert reach == pytest.approx(2.262157 * found.error, rel=1e-5)  # t of 9 degrees, 97.5 %


def test_freedom_is_blocks_less_strata() -> None:
    """Day and night of 6 blocks each: 12 - 2 degrees; the smaller stratum enlarges."""
    sample = ResampledSplit(made(images=60), Resampling(resamples=100, blocks=5))
    values = np.array([10.0, 9.0, 11.0, 9.0, 11.0])  # a standard error of 1
    for part, freedom in (("all", 10), ("day", 5)):
        found = sample.evidence(values, part)
        assert found.images.freedom == freedom
        assert found.error == pytest.approx(math.sqrt(6 / 5))


def test_blocks_of_day_and_night_are_drawn_apart() -> None:
    sample = ResampledSplit(made(images=100), TENS)
    is_night = np.arange(100) >= 50
    for block in range(sample.blocks.count):
        assert len(set(is_night[sample.blocks.index == block])) == 1
    np.testing.assert_array_equal(sample.mean(is_night.astype(float), "night"), 1)
    np.testing.assert_allclose(sample.mean(is_night.astype(float)), 0.5)  # each keeps its number
    assert sample.mean(np.arange(100.0))[0] == pytest.approx(49.5)
    with pytest.raises(InputError, match="part=night: split 'train' of made states no such image"):
        ResampledSplit(made(night=False)).mean(np.arange(40.0), "night")


@pytest.mark.parametrize(("blocks", "known"), [(5, True), (4, False)])
def test_few_blocks_of_what_is_measured_give_no_interval(blocks: int, known: bool) -> None:
    sample = ResampledSplit(made(images=120), TENS)
    present = np.arange(120) < 10 * blocks
    found = sample.evidence(sample.mean(np.arange(120.0)), "all", present)
    assert (found.images is not None, found.blocks) == (known, 11 if known else 4)
    assert math.isnan(sample.bounded(np.array([0.0, *np.ones(100)]))[1])  # no logarithm


@pytest.mark.slow
def test_intervals_cover_the_true_value() -> None:
    """Frames of a block share their scene; a day / night ratio of 1 is inside 95 % of the time."""
    rng = np.random.default_rng(0)
    rounds, inside = 600, {10: 0, 1: 0}
    for _ in range(rounds):
        scene = np.repeat(rng.normal(size=(10, 1)), 10, axis=1).ravel()
        values = np.exp(0.4 * scene + 0.2 * rng.normal(size=100))
        for size in inside:
            drawn = Resampling(resamples=400, blocks=size, seed=int(rng.integers(2**31)))
            sample = ResampledSplit(made(images=100), drawn)
            ratio = sample.mean(values, "day") / sample.mean(values, "night")
            _, low, high = sample.bounded(ratio)
            inside[size] += low <= 1 <= high
    print(f"coverage {inside[10] / rounds:.3f}, without blocks {inside[1] / rounds:.3f}")
    assert 0.93 <= inside[10] / rounds <= 0.99
    assert inside[1] / rounds < 0.7
