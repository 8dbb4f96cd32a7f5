"""Scores of one method with intervals, and differences between two methods."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty import Interval, Resampling, compare, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of

METRICS = ("mIoU", "Var", "region/1", "class/car", "class/cone/acc", "class/cone/region/1")
SETTINGS = Resampling(resamples=200, blocks="none")


def drawn(images: int = 40, trainings: int = 1, seed: int = 0, **changes: Any) -> list[Counts]:
    array = Population(**changes).draw(np.random.default_rng(seed), images, trainings)
    return [counts_of(counts) for counts in array]


def pair(other: Population, images: int = 60, trainings: int = 1) -> list[list[Counts]]:
    arrays = Population(training_sd=0.1).pair(np.random.default_rng(0), images, trainings, other)
    return [[counts_of(counts) for counts in array] for array in arrays]


def looped(seeds: list[Counts], metric: str, absent: str = "released") -> np.ndarray:
    """(resamples,) mean over seeds with every image repeated, as a user would do it."""
    count, names = len(seeds[0].names), sorted(seeds[0].names)
    rng = numpy_generator(SETTINGS.seed, "bootstrap")
    draws = rng.multinomial(count, np.full(count, 1 / count), SETTINGS.resamples)
    picked = ([n for n, w in zip(names, draw, strict=True) for _ in range(w)] for draw in draws)
    return np.array(
        [np.mean([value(metric, seed.select(names), absent) for seed in seeds]) for names in picked]
    )


def scores(seeds: list[Counts], metric: str = "mIoU") -> np.ndarray:
    return np.array([value(metric, counts, "released") for counts in seeds])


def welch(*parts: tuple[float, float]) -> tuple[float, float]:
    """Error and degrees of freedom of a sum of independent (error, freedom)."""
    total = sum(error**2 for error, _ in parts)
    return math.sqrt(total), total**2 / sum(error**4 / freedom for error, freedom in parts)


@pytest.mark.parametrize(
    ("metric", "absent", "pairs"),
    [
        *(("mIoU", "released", False), ("class/cone/region/1", "exclude", False)),
        *(("TC", "released", True), ("CA", "released", True), ("class/cone/TC", "released", True)),
    ],
)
def test_interval_is_students_over_a_loop_over_images(
    metric: str, absent: Any, pairs: bool
) -> None:
    """Pairs of frames are drawn with all their sets."""
    seeds = [pairs_of(20, 0.6, n) for n in range(2)] if pairs else drawn(20, trainings=2)
    found = estimate(seeds, [metric], replace(SETTINGS, absent=absent))[metric]
    draws = looped(seeds, metric, absent)
    np.testing.assert_allclose(found.evidence.drawn, draws, rtol=1e-12)
    half = stats.t.ppf(0.975, 19) * draws.std() * math.sqrt(20 / 19)
    ends = [max(0.0, found.value - half), found.value + half]
    assert [found.images.low, found.images.high] == pytest.approx(ends)


def test_values_are_means_over_seeds_in_requested_order() -> None:
    seeds = drawn(trainings=3, training_sd=0.2)
    found = estimate(seeds, METRICS, SETTINGS)
    assert tuple(found) == METRICS
    for metric, result in found.items():
        assert result.value == pytest.approx(scores(seeds, metric).mean(), rel=1e-12)
        assert result.sd == pytest.approx(scores(seeds, metric).std(ddof=1), rel=1e-9)
        assert (result.seeds, result.evidence.said) == (3, "40 single images")


def test_variance_interval_is_without_the_bias() -> None:
    """The estimate is inside, and so is a true 0, which quantiles of the resamples never hold."""
    for seed in range(3):
        alike = estimate(drawn(tilt=0.0, seed=seed), ["Var"], SETTINGS)["Var"]
        assert 0.0 in alike.images
        assert alike.value in alike.images
        assert np.quantile(alike.evidence.drawn, 0.025) > 0
    # Two trainings whose variance differs by much: Student's interval is cut.
    wide = [drawn(trainings=1, tilt=tilt)[0] for tilt in (0.1, 0.9)]
    found = estimate(wide, ["Var"], SETTINGS)["Var"]
    assert found.value - stats.t.ppf(0.975, 1) * found.sd / math.sqrt(2) < 0
    assert (found.trainings.low, found.both.low) == (0.0, 0.0)


def test_both_adds_the_errors_up() -> None:
    """Many seeds, so that Satterthwaite's interval is the wider one: by hand from its parts."""
    seeds = drawn(trainings=8, training_sd=0.1)
    found = estimate(seeds, ["mIoU"], SETTINGS)["mIoU"]
    of_images = looped(seeds, "mIoU").std() * math.sqrt(40 / 39)
    error, freedom = welch((of_images, 39), (scores(seeds).std(ddof=1) / math.sqrt(8), 7))
    half, mean = stats.t.ppf(0.975, freedom) * error, scores(seeds).mean()
    assert half > found.trainings.half
    assert found.interval == found.both is not None
    assert [found.both.low, found.both.high] == pytest.approx([mean - half, mean + half], rel=1e-10)


def test_too_few_images_use_seeds_only() -> None:
    seeds = drawn(9, trainings=3, training_sd=0.2)
    found = estimate(seeds, ["mIoU"], SETTINGS)["mIoU"]
    assert (found.images, found.both, found.trainings is None) == (None, None, False)
    alone = estimate(seeds[:1], ["mIoU"], SETTINGS)["mIoU"]
    assert (alone.images, alone.trainings, alone.both) == (None, None, None)
    assert estimate(drawn(10), ["mIoU"], SETTINGS)["mIoU"].images is not None


def test_nothing_to_score_is_nan() -> None:
    """It does not count for Holm's correction."""
    sides = []
    for (counts,) in pair(Population()):
        without = counts.counts.copy()
        without[..., 0] += without[..., 3]  # the labels of the others stay what they are
        without[..., 3, :] = without[..., 3] = 0
        sides.append([replace(counts, counts=without)])
    settings = replace(SETTINGS, absent="exclude")
    found = estimate(sides[0], ["class/cone", "mIoU"], settings)
    assert math.isnan(found["class/cone"].value)
    assert (found["class/cone"].images, found["mIoU"].images is None) == (None, False)
    released = estimate(sides[0], ["class/cone"], SETTINGS)["class/cone"]
    assert released.images == Interval(0.0, 0.0)
    metrics = ["class/cone", "class/car", "class/car"]
    nothing, some = compare(*sides, metrics, settings).differences
    assert nothing.interval is None
    assert all(
        map(math.isnan, (nothing.value, nothing.difference.p, nothing.difference.p_corrected))
    )
    assert some.difference.p_corrected == some.difference.p


def test_night_is_scored_on_its_own_images() -> None:
    (counts,) = drawn()
    counts = replace(counts, night=tuple(place % 2 == 0 for place in range(40)))
    found = estimate([counts], ["night/mIoU", "mIoU", "day/mIoU"], SETTINGS)
    for metric, result in found.items():
        assert result.value == pytest.approx(value(metric, counts, "released"))
    assert found["night/mIoU"].evidence.said == "20 of 40 single images"


# Differences.


def test_seeds_of_two_methods_are_not_paired() -> None:
    """Images: spread of the paired resamples; seeds: Welch; 39 degrees for 40 images."""
    a, b = pair(Population(skill=1.7, training_sd=0.02), 40, 8)
    b = b[:6]
    (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
    of_images = (looped(b, "mIoU") - looped(a, "mIoU")).std() * math.sqrt(40 / 39), 39
    errors = [(scores(side).std(ddof=1) / math.sqrt(len(side)), len(side) - 1) for side in (a, b)]
    of_seeds = welch(*errors)
    ways = (welch(of_images, of_seeds), of_seeds)
    half = max(stats.t.ppf(0.975, freedom) * error for error, freedom in ways)
    difference = scores(b).mean() - scores(a).mean()
    ends = [found.difference.both.low, found.difference.both.high]
    assert ends == pytest.approx([difference - half, difference + half], rel=1e-9)


def test_both_is_never_narrower_than_seeds_only() -> None:
    """Two trainings each: else 6 % false alarms at 5 % (1000 simulations), and 3 % so."""
    a, b = pair(Population(training_sd=0.3), 40, 2)
    (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
    theirs = stats.ttest_ind(scores(b), scores(a), equal_var=False).confidence_interval(0.95)
    assert (found.difference.p < 0.05) == (0.0 not in found.difference.both)
    assert found.difference.both.half >= (theirs.high - theirs.low) / 2 - 1e-9
    for one, other in ((a[:1], b), (a, b[:1])):  # one seed on one side: images only
        (found,) = compare(one, other, ["mIoU"], SETTINGS).differences
        assert found.difference.both is None
        assert found.interval == found.difference.images is not None


# Images.


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"classes": ("road", "car", "person", "pole")}, "counts of the classes"),
        ({"partition": "vertical2"}, "cannot be compared with counts by vertical2"),
        ({"names": tuple(f"x{n}" for n in range(60))}, "not of the same images: 60 "),
        ({"unscored": ("car",)}, "leave out"),
        ({"night": tuple(n % 2 > 0 for n in range(60))}, "which images were taken at night"),
    ],
)
def test_counts_of_other_things_are_refused(changed: dict[str, Any], word: str) -> None:
    a, b = pair(Population())
    a = [replace(a[0], night=tuple(n % 2 == 0 for n in range(60)))]
    with pytest.raises(InputError, match=word):
        compare(a, [counts_of(b[0].counts, **changed)], ["mIoU"], SETTINGS)


def test_other_labels_and_too_few_images_are_refused() -> None:
    a, b = pair(Population())
    array = b[0].counts.copy()
    array[7, 0, 1] += 1
    with pytest.raises(InputError, match="has different labels in the two counts"):
        compare(a, [replace(b[0], counts=array)], ["mIoU"], SETTINGS)
    night = tuple(place < 9 for place in range(60))
    a, b = ([replace(side[0], night=night)] for side in (a, b))
    assert compare(a, b, ["mIoU", "night/mIoU"], SETTINGS).differences[1].interval is None
    with pytest.raises(InputError, match="9 of 60 single images are too few"):
        compare(a, b, ["night/mIoU"], SETTINGS)
