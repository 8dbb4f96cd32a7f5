"""Scores of one method with intervals."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty import Interval, Resampling, estimate
from analysis.uncertainty.images import prepare
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import parse, value
from tests.analysis.uncertainty.simulated import Population, counts_of

METRICS = ("mIoU", "Var", "region/1", "region/2", "class/car", "class/cone/acc")
SETTINGS = Resampling(resamples=400, blocks="none")


def drawn(images: int = 40, trainings: int = 1, seed: int = 0, **changes) -> list[Counts]:
    array = Population(**changes).draw(np.random.default_rng(seed), images, trainings)
    return [counts_of(each) for each in array]


def test_values_are_means_over_seeds_in_requested_order():
    seeds = drawn(trainings=3, training_sd=0.2)
    found = estimate(seeds, METRICS, SETTINGS)
    assert tuple(found) == METRICS
    for metric, each in found.items():
        scores = [value(metric, counts, "released") for counts in seeds]
        assert each.value == pytest.approx(np.mean(scores), rel=1e-12)
        assert each.sd == pytest.approx(np.std(scores, ddof=1), rel=1e-9)
        assert each.seeds == 3
        assert each.said == "40 single images"


def test_variance_interval_is_students_without_the_bias():
    """By hand from the resamples; the estimate is inside, and nothing below 0 is."""
    seeds, settings = drawn(), replace(SETTINGS, level=0.9)
    found = estimate(seeds, ["Var"], settings)["Var"]
    (resampled,) = prepare([seeds], parse("Var"), settings).resampled([parse("Var")])
    centre = 2 * found.value - resampled[0].mean()
    half = stats.t.ppf(0.95, 39) * resampled[0].std() * math.sqrt(40 / 39)
    assert found.images is not None
    assert found.images.low == pytest.approx(max(0.0, centre - half))
    assert found.images.high == pytest.approx(max(found.value, centre + half))
    assert found.value in found.images
    for seed in range(5):
        alike = estimate(drawn(tilt=0.0, seed=seed), ["Var"], SETTINGS)["Var"]
        assert alike.images is not None
        assert 0.0 in alike.images
        assert alike.value in alike.images


def test_bca_interval_is_near_scipys():
    """Pixel accuracy of paired (right, all) pixels by image; both draw their own resamples."""
    counts = drawn(60)[0]
    right = np.trace(counts.counts.sum(1), axis1=1, axis2=2).astype(float)
    every = counts.counts.sum((1, 2, 3)).astype(float)

    def score(right: np.ndarray, every: np.ndarray, axis: int = -1) -> np.ndarray:
        return 100 * right.sum(axis) / every.sum(axis)

    theirs = stats.bootstrap((right, every), score, paired=True, n_resamples=20_000, rng=0)
    settings = replace(SETTINGS, resamples=20_000)
    found = estimate([counts], ["pixel_accuracy"], settings)["pixel_accuracy"].images
    expected = theirs.confidence_interval
    assert found is not None
    width = expected.high - expected.low
    np.testing.assert_allclose([found.low, found.high], expected, atol=0.03 * width)


def test_both_adds_the_errors_up():
    """Many seeds, so that Satterthwaite's interval is the wider one: by hand from its parts."""
    seeds = drawn(trainings=8, training_sd=0.1)
    settings = replace(SETTINGS, method="percentile")
    found = estimate(seeds, ["mIoU"], settings)["mIoU"]
    scores = np.array([value("mIoU", counts, "released") for counts in seeds])
    (resampled,) = prepare([seeds], parse("mIoU"), settings).resampled([parse("mIoU")])
    of_images = resampled[0].std() * math.sqrt(40 / 39)
    of_seeds = scores.std(ddof=1) / math.sqrt(8)
    squares = of_images**2 + of_seeds**2
    freedom = squares**2 / (of_images**4 / 39 + of_seeds**4 / 7)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(squares)
    assert found.both is not None
    assert found.trainings is not None
    assert half > found.trainings.half
    assert found.both.low == pytest.approx(scores.mean() - half, rel=1e-10)
    assert found.both.high == pytest.approx(scores.mean() + half, rel=1e-10)


def test_too_few_images_use_seeds_only():
    seeds = drawn(9, trainings=3, training_sd=0.2)
    found = estimate(seeds, ["mIoU"], SETTINGS)["mIoU"]
    assert found.images is None
    assert found.both is None
    assert found.trainings is not None
    assert found.value == pytest.approx(
        np.mean([value("mIoU", counts, "released") for counts in seeds])
    )
    alone = estimate(seeds[:1], ["mIoU"], SETTINGS)["mIoU"]
    assert (alone.images, alone.both) == (None, None)
    assert estimate(drawn(10), ["mIoU"], SETTINGS)["mIoU"].images is not None


def test_nothing_to_score_is_nan():
    counts = drawn(20)[0]
    without = counts.counts.copy()
    without[:, :, 3, :] = without[:, :, :, 3] = 0
    empty = replace(counts, counts=without)
    settings = replace(SETTINGS, absent="exclude")
    found = estimate([empty, empty], ["class/cone", "mIoU"], settings)
    assert math.isnan(found["class/cone"].value)
    assert found["class/cone"].images is None
    assert found["class/cone"].both is None
    assert found["mIoU"].images is not None
    released = estimate([empty], ["class/cone"], SETTINGS)["class/cone"]
    assert released.images == Interval(0.0, 0.0)


def test_a_class_that_most_resamples_miss():
    """Cone in one image alone: resamples without it have no score and are left out."""
    array = np.zeros((30, 2, 4, 4), np.int64)
    array[..., 0, 0] = 100
    array[4, 0, 3] = (20, 0, 0, 60)
    asked = ["class/cone"]
    excluded = estimate([counts_of(array)], asked, replace(SETTINGS, absent="exclude"))[asked[0]]
    assert excluded.images == Interval(75.0, 75.0)
    released = estimate([counts_of(array)], asked, replace(SETTINGS, method="percentile"))[asked[0]]
    assert released.images == Interval(0.0, 75.0)


def test_correlated_neighbours_make_wider_intervals():
    """Ten frames of each scene are nearly one piece of evidence."""
    seeds = drawn(300, block=10, noise_sd=0.0, image_sd=1.0)
    halves = {}
    for blocks in ("none", "auto", 10):
        found = estimate(seeds, ["mIoU"], replace(SETTINGS, blocks=blocks))["mIoU"]
        assert found.images is not None
        halves[blocks] = found.images.half
    assert halves[10] > 2 * halves["none"]
    assert halves["auto"] > 1.7 * halves["none"]


def test_interval_does_not_depend_on_other_requested_metrics():
    """The class is correlated over other lengths than the mean is."""
    seeds = drawn(300, seed=3, block=12, image_sd=1.5)
    settings = replace(SETTINGS, blocks="auto")
    alone = estimate(seeds, ["class/cone"], settings)["class/cone"]
    first = estimate(seeds, ["class/cone", "mIoU"], settings)["class/cone"]
    second = estimate(seeds, ["mIoU", "class/cone"], settings)["class/cone"]
    assert alone.images is not None
    assert first.images == second.images == alone.images
    assert first.said == second.said == alone.said


def test_day_and_night_together_with_all():
    at_night = tuple(place % 2 == 0 for place in range(40))
    (counts,) = drawn()
    counts = replace(counts, night=at_night)
    metrics = ["night/mIoU", "mIoU", "day/mIoU", "night/Var"]
    found = estimate([counts], metrics, SETTINGS)
    assert list(found) == metrics
    for metric in metrics:
        assert found[metric].value == pytest.approx(value(metric, counts, "released"))
    assert found["night/mIoU"].said == "20 single images"
    assert found["mIoU"].said == "40 single images"


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        *(({"level": value}, "level must be between") for value in (2.0, 0.3, math.nan)),
        *(({"resamples": value}, "resamples must be between") for value in (99, 10**9)),
        ({"method": "t"}, "method: 't' is not a valid choice"),
        ({"absent": "zero"}, "absent: 'zero' is not a valid choice"),
        ({"blocks": 0}, "blocks must be between"),
        ({"blocks": "abc"}, "expected auto, none, sequence or a number of images"),
    ],
)
def test_settings_out_of_range_are_refused(changes, word: str):
    with pytest.raises(InputError, match=word):
        Resampling(**changes)


def test_no_score_is_below_zero():
    """Two trainings whose variance over regions differs by much: Student's interval is cut."""
    wide = [drawn(trainings=1, tilt=tilt)[0] for tilt in (0.1, 0.9)]
    found = estimate(wide, ["Var"], SETTINGS)["Var"]
    assert found.trainings is not None
    assert found.both is not None
    assert found.value - stats.t.ppf(0.975, 1) * found.sd / math.sqrt(2) < 0
    assert (found.trainings.low, found.both.low) == (0.0, 0.0)
