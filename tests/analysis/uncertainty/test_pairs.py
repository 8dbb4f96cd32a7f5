"""Two methods on the same images."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty import Comparison, Resampling, compare
from analysis.uncertainty.images import prepare
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import parse, value
from tests.analysis.uncertainty.simulated import Population, counts_of

METRICS = ("mIoU", "Var", "region/1", "class/car")
SETTINGS = Resampling(resamples=400, blocks="none")
PLAIN = Population()


def pair(
    other: Population, images: int = 60, trainings: int = 1, seed: int = 0, first=PLAIN
) -> list[list[Counts]]:
    arrays = first.pair(np.random.default_rng(seed), images, trainings, other)
    return [[counts_of(each) for each in array] for array in arrays]


def flat(comparison: Comparison) -> list[float]:
    return [
        number
        for each in comparison.differences
        for number in (each.value, each.p_images, each.images.low, each.images.high)
    ]


def test_planted_difference_is_found_with_its_size():
    """Skill 1.5 against 2.3; the true size is that of 20,000 images."""
    population, better = Population(), Population(skill=2.3)
    arrays = population.pair(np.random.default_rng(7), 20_000, 1, better)
    truth = {
        metric: value(metric, counts_of(arrays[1][0]), "released")
        - value(metric, counts_of(arrays[0][0]), "released")
        for metric in METRICS
    }
    assert truth["mIoU"] > 5
    comparison = compare(*pair(better, 200), METRICS, replace(SETTINGS, level=0.99))
    assert [each.metric for each in comparison.differences] == list(METRICS)
    assert (comparison.images, comparison.said) == (200, "200 single images")
    for each in comparison.differences:
        assert each.images is not None
        assert truth[each.metric] in each.images
    for each in comparison.differences[::2]:
        assert each.p == each.p_images == pytest.approx(1 / 401)
        assert 0.0 not in each.images
        assert each.value == pytest.approx(truth[each.metric], abs=3)
        assert each.p_corrected == pytest.approx(min(1, each.p * 4), abs=0.02)


def test_both_by_hand():
    """Images: spread of the paired resamples; seeds: Welch; 39 degrees for 40 images.

    Trainings that hardly differ, so that this is wider than the interval over them alone.
    """
    a, b = pair(Population(skill=1.7, training_sd=0.02), 40, 8, first=Population())
    b = b[:6]
    (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
    scores = [np.array([value("mIoU", each, "released") for each in side]) for side in (a, b)]
    first, second = prepare([a, b], parse("mIoU"), SETTINGS).resampled([parse("mIoU")])
    of_images = (second - first)[0].std() * math.sqrt(40 / 39)
    errors = [each.std(ddof=1) / math.sqrt(len(each)) for each in scores]
    of_seeds = errors[0] ** 2 + errors[1] ** 2
    seeds_freedom = of_seeds**2 / (errors[0] ** 4 / 7 + errors[1] ** 4 / 5)
    total = of_images**2 + of_seeds
    freedom = total**2 / (of_images**4 / 39 + of_seeds**2 / seeds_freedom)
    difference = scores[1].mean() - scores[0].mean()
    half = stats.t.ppf(0.975, freedom) * math.sqrt(total)
    assert half > stats.t.ppf(0.975, seeds_freedom) * math.sqrt(of_seeds)
    assert found.both is not None
    assert found.value == pytest.approx(difference, rel=1e-10)
    assert found.both.low == pytest.approx(difference - half, rel=1e-9)
    assert found.both.high == pytest.approx(difference + half, rel=1e-9)
    expected = 2 * stats.t.sf(abs(difference) / math.sqrt(total), freedom)
    assert found.p_both == pytest.approx(expected, rel=1e-9)


def test_both_is_never_narrower_than_seeds_only():
    """Two trainings each: else 6 % false alarms at 5 % (1000 simulations), and 3 % so."""
    varied = Population(training_sd=0.3)
    for seed in range(10):
        a, b = pair(varied, 40, 2, seed, first=varied)
        (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
        scores = [[value("mIoU", each, "released") for each in side] for side in (a, b)]
        welch = stats.ttest_ind(scores[1], scores[0], equal_var=False)
        expected = welch.confidence_interval(0.95)
        assert found.both is not None
        assert (found.p_both < 0.05) == (0.0 not in found.both)
        assert found.both.half >= (expected.high - expected.low) / 2 - 1e-9


def test_the_same_predictions():
    a, _ = pair(Population(), trainings=2)
    for each in compare(a, a, METRICS, SETTINGS).differences:
        assert each.value == 0.0
        assert each.p_images == 1.0
        assert each.images is not None
        assert (each.images.low, each.images.high) == (0.0, 0.0)
        assert each.p_corrected == pytest.approx(1.0)


def test_one_seed_on_one_side_uses_images_only():
    a, b = pair(Population(), trainings=3)
    for one, other in ((a[:1], b), (a, b[:1])):
        (found,) = compare(one, other, ["mIoU"], SETTINGS).differences
        assert found.both is None
        assert math.isnan(found.p_both)
        assert found.interval == found.images is not None
        assert found.p == found.p_images


def test_nothing_to_score():
    a, b = pair(Population())
    emptied = []
    for counts in (a[0], b[0]):
        without = counts.counts.copy()
        without[..., 0] += without[..., 3]  # the labels of the others stay what they are
        without[..., 3, :] = without[..., 3] = 0
        emptied.append([replace(counts, counts=without)])
    settings = replace(SETTINGS, absent="exclude")
    nothing, some = compare(*emptied, ["class/cone", "class/car"], settings).differences
    assert nothing.images is None
    assert nothing.interval is None
    assert all(map(math.isnan, (nothing.value, nothing.p_images, nothing.p_corrected)))
    assert some.p_corrected == some.p  # what cannot be scored is not counted


def test_too_few_images_are_refused():
    a, b = pair(Population(), 9)
    with pytest.raises(InputError, match="9 single images are too few .* 10 are the least"):
        compare(a, b, ["mIoU"], SETTINGS)


def test_metric_requested_twice_counts_once_for_holm():
    a, b = pair(Population(skill=1.7))
    once = compare(a, b, ["mIoU", "Var"], SETTINGS)
    twice = compare(a, b, ["mIoU", "mIoU", "Var"], SETTINGS)
    expected = {each.metric: each.p_corrected for each in once.differences}
    assert {each.metric: each.p_corrected for each in twice.differences} == expected


def test_numbers_of_the_images_belong_to_the_first_difference():
    """10 of 60 images at night; the sentence is about the first difference."""
    a, b = pair(Population())
    night = tuple(place < 10 for place in range(60))
    a, b = ([replace(side[0], night=night)] for side in (a, b))
    first = compare(a, b, ["mIoU", "night/mIoU"], SETTINGS)
    assert (first.images, first.said) == (60, "60 single images")
    for metrics in (["night/mIoU"], ["night/mIoU", "mIoU"], ["night/mIoU", "day/mIoU"]):
        found = compare(a, b, metrics, SETTINGS)
        assert (found.images, found.said) == (10, "10 single images"), metrics


def test_same_seed_same_numbers():
    a, b = pair(Population(skill=1.7), 70)
    first, again = (flat(compare(a, b, METRICS, replace(SETTINGS, blocks="auto"))) for _ in "12")
    assert first == again
    assert first != flat(compare(a, b, METRICS, replace(SETTINGS, blocks="auto", seed=1)))


def test_order_of_the_names_of_b_does_not_matter():
    a, b = pair(Population(skill=1.7), 70)
    shuffled = b[0].select(np.random.default_rng(1).permutation(b[0].names).tolist())
    settings = replace(SETTINGS, blocks="auto")
    assert flat(compare(a, b, METRICS, settings)) == flat(compare(a, [shuffled], METRICS, settings))


def test_p_of_swapped_images_against_all_swaps():
    """Ten images with one informative pixel count each: all 2^10 exchanges."""
    rng = np.random.default_rng(4)
    a, b = rng.integers(300, 700, (2, 10))
    arrays = np.zeros((2, 10, 2, 4, 4), np.int64)
    for array, right in zip(arrays, (a, b), strict=True):
        array[:, 0, 0, 0], array[:, 0, 0, 1] = right, 1000 - right
    bits = (np.arange(1024)[:, None] >> np.arange(10)) & 1
    every = (1 - 2 * bits) @ (b - a)
    exact = (np.abs(every) >= abs((b - a).sum())).mean()
    settings = replace(SETTINGS, resamples=8000)
    sides = [[counts_of(array)] for array in arrays]
    (found,) = compare(*sides, ["pixel_accuracy"], settings).differences
    assert found.value == pytest.approx((b - a).sum() / 100)
    assert found.p_images == pytest.approx(exact, abs=4 * math.sqrt(exact * (1 - exact) / 8000))


# Rates: see also test_rates.py, which takes longer.


def test_two_evaluations_of_the_same_trainings_are_paired():
    """Trainings differ by much, and what the second evaluation loses hardly: a narrow interval."""
    varied = Population(training_sd=0.8)
    first, _ = pair(varied, 200, 3, first=varied)
    second = [replace(counts, counts=shifted(counts.counts)) for counts in first]
    settings = replace(SETTINGS, blocks="none")
    (paired,) = compare(first, second, ["mIoU"], settings, paired=True).differences
    (apart,) = compare(first, second, ["mIoU"], settings).differences
    drops = [
        value("mIoU", after, "released") - value("mIoU", before, "released")
        for before, after in zip(first, second, strict=True)
    ]
    assert paired.both is not None
    assert apart.both is not None
    assert paired.value == pytest.approx(np.mean(drops))
    error = stats.sem(drops)
    assert paired.both.half >= stats.t.ppf(0.975, 2) * error - 1e-9
    assert paired.both.half < apart.both.half / 2


def shifted(counts: np.ndarray) -> np.ndarray:
    """A tenth of what was right is wrong."""
    moved = counts.copy()
    for row in range(counts.shape[-1]):
        lost = counts[..., row, row] // 10
        moved[..., row, row] -= lost
        moved[..., row, row - 1] += lost
    return moved
