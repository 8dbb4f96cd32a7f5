"""Scores of one method with intervals, and differences between two methods."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy import stats

from analysis.uncertainty import Interval, Resampling, compare, estimate
from analysis.uncertainty.same_images import common
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of

METRICS = ("mIoU", "Var", "region/1", "class/car", "class/cone/acc", "class/cone/region/1")
SETTINGS = Resampling(resamples=200, blocks="none")


def drawn(images: int = 40, trainings: int = 1, seed: int = 0, **changes: Any) -> list[Counts]:
    array = Population(**changes).draw(np.random.default_rng(seed), images, trainings)
    return [counts_of(each) for each in array]


def pair(other: Population, images: int = 60, trainings: int = 1) -> list[list[Counts]]:
    arrays = Population(training_sd=0.1).pair(np.random.default_rng(0), images, trainings, other)
    return [[counts_of(each) for each in array] for array in arrays]


def looped(seeds: list[Counts], metric: str, absent: str = "released") -> np.ndarray:
    """(resamples,) mean over seeds with every image repeated, as a user would do it."""
    count, names = len(seeds[0].names), sorted(seeds[0].names)
    rng = numpy_generator(SETTINGS.seed, "bootstrap")
    draws = rng.multinomial(count, np.full(count, 1 / count), SETTINGS.resamples)
    picked = ([n for n, w in zip(names, draw, strict=True) for _ in range(w)] for draw in draws)
    return np.array(
        [np.mean([value(metric, each.select(names), absent) for each in seeds]) for names in picked]
    )


@pytest.mark.parametrize("absent", ["released", "exclude"])
@pytest.mark.parametrize("metric", ["mIoU", "class/car", "class/cone/region/1"])
def test_interval_is_students_over_a_loop_over_images(metric: str, absent: Any) -> None:
    seeds = drawn(20, trainings=2)
    found = estimate(seeds, [metric], replace(SETTINGS, absent=absent))[metric]
    draws = looped(seeds, metric, absent)
    np.testing.assert_allclose(found.evidence.drawn, draws, rtol=1e-12)
    half = stats.t.ppf(0.975, 19) * draws.std() * math.sqrt(20 / 19)
    assert found.images is not None
    assert found.images.low == pytest.approx(max(0.0, found.value - half))
    assert found.images.high == pytest.approx(found.value + half)


def test_pairs_of_frames_are_drawn_with_all_their_sets() -> None:
    seeds = [pairs_of(14, 0.6, seed) for seed in range(2)]
    for metric in ("TC", "CA", "CA_released", "class/cone/TC"):
        found = estimate(seeds, [metric], SETTINGS)[metric]
        np.testing.assert_allclose(found.evidence.drawn, looped(seeds, metric), rtol=1e-12)


def test_values_are_means_over_seeds_in_requested_order() -> None:
    seeds = drawn(trainings=3, training_sd=0.2)
    found = estimate(seeds, METRICS, SETTINGS)
    assert tuple(found) == METRICS
    for metric, each in found.items():
        scores = [value(metric, counts, "released") for counts in seeds]
        assert each.value == pytest.approx(np.mean(scores), rel=1e-12)
        assert each.sd == pytest.approx(np.std(scores, ddof=1), rel=1e-9)
        assert (each.seeds, each.said) == (3, "40 single images")


def test_variance_interval_is_without_the_bias() -> None:
    """The estimate is inside, and so is a true 0, which quantiles of the resamples never hold."""
    for seed in range(5):
        alike = estimate(drawn(tilt=0.0, seed=seed), ["Var"], SETTINGS)["Var"]
        assert alike.images is not None
        assert 0.0 in alike.images
        assert alike.value in alike.images
        assert np.quantile(alike.evidence.drawn, 0.025) > 0


def test_both_adds_the_errors_up() -> None:
    """Many seeds, so that Satterthwaite's interval is the wider one: by hand from its parts."""
    seeds = drawn(trainings=8, training_sd=0.1)
    found = estimate(seeds, ["mIoU"], SETTINGS)["mIoU"]
    scores = np.array([value("mIoU", counts, "released") for counts in seeds])
    of_images = looped(seeds, "mIoU").std() * math.sqrt(40 / 39)
    of_seeds = scores.std(ddof=1) / math.sqrt(8)
    squares = of_images**2 + of_seeds**2
    freedom = squares**2 / (of_images**4 / 39 + of_seeds**4 / 7)
    half = stats.t.ppf(0.975, freedom) * math.sqrt(squares)
    assert found.trainings is not None
    assert half > found.trainings.half
    assert found.interval == found.both is not None
    ends = [scores.mean() - half, scores.mean() + half]
    assert [found.both.low, found.both.high] == pytest.approx(ends, rel=1e-10)


def test_too_few_images_use_seeds_only() -> None:
    seeds = drawn(9, trainings=3, training_sd=0.2)
    found = estimate(seeds, ["mIoU"], SETTINGS)["mIoU"]
    assert (found.images, found.both) == (None, None)
    assert found.trainings is not None
    alone = estimate(seeds[:1], ["mIoU"], SETTINGS)["mIoU"]
    assert (alone.images, alone.trainings, alone.both) == (None, None, None)
    assert estimate(drawn(10), ["mIoU"], SETTINGS)["mIoU"].images is not None


def test_nothing_to_score_is_nan() -> None:
    counts = drawn(20)[0]
    without = counts.counts.copy()
    without[:, :, 3, :] = without[:, :, :, 3] = 0
    empty = replace(counts, counts=without)
    found = estimate([empty, empty], ["class/cone", "mIoU"], replace(SETTINGS, absent="exclude"))
    assert math.isnan(found["class/cone"].value)
    assert (found["class/cone"].images, found["class/cone"].both) == (None, None)
    assert found["mIoU"].images is not None
    released = estimate([empty], ["class/cone"], SETTINGS)["class/cone"]
    assert released.images == Interval(0.0, 0.0)


def test_correlated_neighbours_make_wider_intervals() -> None:
    """Ten frames of each scene are nearly one piece of evidence."""
    seeds = drawn(300, block=10, noise_sd=0.0, image_sd=1.0)
    halves = {}
    for blocks in ("none", "auto", 10):
        found = estimate(seeds, ["mIoU"], replace(SETTINGS, blocks=blocks))["mIoU"]
        assert found.images is not None
        halves[blocks] = found.images.half
    assert halves[10] > 2 * halves["none"]
    assert halves["auto"] > 1.7 * halves["none"]


def test_night_is_scored_on_its_own_images() -> None:
    (counts,) = drawn()
    counts = replace(counts, night=tuple(place % 2 == 0 for place in range(40)))
    found = estimate([counts], ["night/mIoU", "mIoU", "day/mIoU"], SETTINGS)
    for metric, each in found.items():
        assert each.value == pytest.approx(value(metric, counts, "released"))
    assert found["night/mIoU"].said == "20 of 40 single images"
    assert found["mIoU"].said == "40 single images"


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        *(({"level": value}, "level must be between") for value in (2.0, 0.3, math.nan)),
        *(({"resamples": value}, "resamples must be between") for value in (99, 10**9)),
        ({"absent": "zero"}, "absent: 'zero' is not a valid choice"),
        ({"blocks": 0}, "blocks must be between"),
        ({"blocks": "abc"}, "'abc' is not a valid choice"),
    ],
)
def test_settings_out_of_range_are_refused(changes: Any, word: str) -> None:
    with pytest.raises(InputError, match=word):
        Resampling(**changes)


def test_no_score_is_below_zero() -> None:
    """Two trainings whose variance over regions differs by much: Student's interval is cut."""
    wide = [drawn(trainings=1, tilt=tilt)[0] for tilt in (0.1, 0.9)]
    found = estimate(wide, ["Var"], SETTINGS)["Var"]
    assert found.trainings is not None
    assert found.both is not None
    assert found.value - stats.t.ppf(0.975, 1) * found.sd / math.sqrt(2) < 0
    assert (found.trainings.low, found.both.low) == (0.0, 0.0)


# Differences.


def test_planted_difference_is_found_with_its_size() -> None:
    """Skill 1.5 against 2.3; the true size is that of 20,000 images."""
    metrics = ("mIoU", "Var", "region/1", "class/car")
    arrays = Population().pair(np.random.default_rng(7), 20_000, 1, Population(skill=2.3))
    truth = {
        metric: value(metric, counts_of(arrays[1][0]), "released")
        - value(metric, counts_of(arrays[0][0]), "released")
        for metric in metrics
    }
    found = compare(*pair(Population(skill=2.3), 200), metrics, replace(SETTINGS, level=0.99))
    assert [each.metric for each in found.differences] == list(metrics)
    assert (found.images, found.said) == (200, "200 single images")
    for each in found.differences:
        assert each.interval is not None
        assert truth[each.metric] in each.interval
    for each in found.differences[::2]:
        assert each.difference.p < 0.001
        assert each.value == pytest.approx(truth[each.metric], abs=3)


def test_seeds_of_two_methods_are_not_paired() -> None:
    """Images: spread of the paired resamples; seeds: Welch; 39 degrees for 40 images."""
    a, b = pair(Population(skill=1.7, training_sd=0.02), 40, 8)
    b = b[:6]
    (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
    scores = [np.array([value("mIoU", each, "released") for each in side]) for side in (a, b)]
    of_images = (looped(b, "mIoU") - looped(a, "mIoU")).std() * math.sqrt(40 / 39)
    errors = [each.std(ddof=1) / math.sqrt(len(each)) for each in scores]
    of_seeds = errors[0] ** 2 + errors[1] ** 2
    seeds_freedom = of_seeds**2 / (errors[0] ** 4 / 7 + errors[1] ** 4 / 5)
    total = of_images**2 + of_seeds
    freedom = total**2 / (of_images**4 / 39 + of_seeds**2 / seeds_freedom)
    half = max(
        stats.t.ppf(0.975, freedom) * math.sqrt(total),
        stats.t.ppf(0.975, seeds_freedom) * math.sqrt(of_seeds),
    )
    difference = scores[1].mean() - scores[0].mean()
    assert found.difference.both is not None
    ends = [found.difference.both.low, found.difference.both.high]
    assert ends == pytest.approx([difference - half, difference + half], rel=1e-9)


def test_both_is_never_narrower_than_seeds_only() -> None:
    """Two trainings each: else 6 % false alarms at 5 % (1000 simulations), and 3 % so."""
    a, b = pair(Population(training_sd=0.3), 40, 2)
    (found,) = compare(a, b, ["mIoU"], SETTINGS).differences
    scores = [[value("mIoU", each, "released") for each in side] for side in (a, b)]
    welch = stats.ttest_ind(scores[1], scores[0], equal_var=False).confidence_interval(0.95)
    assert found.difference.both is not None
    assert (found.difference.p < 0.05) == (0.0 not in found.difference.both)
    assert found.difference.both.half >= (welch.high - welch.low) / 2 - 1e-9


def test_same_predictions_differ_by_nothing() -> None:
    a, _ = pair(Population())
    for each in compare(a, a, METRICS[:4], SETTINGS).differences:
        assert (each.value, each.interval) == (0.0, Interval(0.0, 0.0))
        assert (each.difference.p, each.p_corrected) == (1.0, 1.0)


def test_one_seed_on_one_side_uses_images_only() -> None:
    a, b = pair(Population(), trainings=3)
    for one, other in ((a[:1], b), (a, b[:1])):
        (found,) = compare(one, other, ["mIoU"], SETTINGS).differences
        assert found.difference.both is None
        assert found.interval == found.difference.images is not None


def test_what_cannot_be_scored_does_not_count_for_holm() -> None:
    a, b = pair(Population())
    emptied = []
    for counts in (a[0], b[0]):
        without = counts.counts.copy()
        without[..., 0] += without[..., 3]  # the labels of the others stay what they are
        without[..., 3, :] = without[..., 3] = 0
        emptied.append([replace(counts, counts=without)])
    settings = replace(SETTINGS, absent="exclude")
    nothing, some = compare(*emptied, ["class/cone", "class/car"], settings).differences
    assert nothing.interval is None
    assert all(map(math.isnan, (nothing.value, nothing.difference.p, nothing.p_corrected)))
    assert some.p_corrected == some.difference.p
    twice = compare(a, b, ["mIoU", "mIoU", "Var"], SETTINGS)
    assert len(twice.differences) == 2


def test_too_few_images_are_refused() -> None:
    a, b = pair(Population(), 60)
    night = tuple(place < 9 for place in range(60))
    a, b = ([replace(side[0], night=night)] for side in (a, b))
    assert compare(a, b, ["mIoU", "night/mIoU"], SETTINGS).differences[1].interval is None
    with pytest.raises(InputError, match="9 of 60 single images are too few"):
        compare(a, b, ["night/mIoU"], SETTINGS)


def test_order_of_names_and_seed_of_draws() -> None:
    a, b = pair(Population(skill=1.7), 70)
    shuffled = b[0].select(np.random.default_rng(1).permutation(b[0].names).tolist())
    settings = replace(SETTINGS, blocks="auto")
    first = compare(a, b, METRICS[:4], settings)
    assert compare(a, [shuffled], METRICS[:4], settings) == first
    assert compare(a, b, METRICS[:4], replace(settings, seed=1)) != first


def test_two_evaluations_of_the_same_trainings_are_paired() -> None:
    """Trainings differ by much, and what the second evaluation loses hardly: a narrow interval."""
    first = drawn(200, 3, training_sd=0.8)
    second = [replace(counts, counts=_shifted(counts.counts)) for counts in first]
    (paired,) = compare(first, second, ["mIoU"], SETTINGS, paired=True).differences
    (apart,) = compare(first, second, ["mIoU"], SETTINGS).differences
    scores = [[value("mIoU", each, "released") for each in side] for side in (first, second)]
    drops = np.subtract(scores[1], scores[0])
    assert paired.value == pytest.approx(drops.mean())
    assert paired.difference.both.half >= stats.t.ppf(0.975, 2) * stats.sem(drops) - 1e-9
    assert paired.difference.both.half < apart.difference.both.half / 2
    with pytest.raises(InputError, match="as many counts in a and b"):
        compare(first, second[:2], ["mIoU"], SETTINGS, paired=True)


def _shifted(counts: np.ndarray) -> np.ndarray:
    """A tenth of what was right is wrong."""
    moved = counts.copy()
    for row in range(counts.shape[-1]):
        lost = counts[..., row, row] // 10
        moved[..., row, row] -= lost
        moved[..., row, row - 1] += lost
    return moved


# Images.


@pytest.mark.parametrize(
    ("changed", "word"),
    [
        ({"classes": ("road", "car", "person", "pole")}, "counts of the classes"),
        ({"partition": "vertical2"}, "cannot be compared with counts by vertical2"),
        (
            {"names": tuple(f"x{n}" for n in range(60))},
            "are not of the same images: 60 .*none is in both",
        ),
        ({"unscored": ("car",)}, "leave out"),
    ],
)
def test_counts_of_other_things_are_refused(changed: dict[str, Any], word: str) -> None:
    a, b = pair(Population())
    with pytest.raises(InputError, match=word):
        compare(a, [replace(b[0], **changed)], ["mIoU"], SETTINGS)


def test_other_labels_of_an_image_are_refused() -> None:
    a, b = pair(Population())
    array = b[0].counts.copy()
    array[7, 0, 1] += 1
    with pytest.raises(InputError, match="has different labels in the two counts"):
        compare(a, [replace(b[0], counts=array)], ["mIoU"], SETTINGS)


def test_common_images_are_those_of_all_counts() -> None:
    a, b = pair(Population())
    less = b[0].select(b[0].names[5:])
    (first,), (second,) = common([a, [less]])
    assert first.names == second.names == b[0].names[5:]
    with pytest.raises(InputError, match="no image is in all counts"):
        common([[a[0].select(a[0].names[:5])], [less]])
