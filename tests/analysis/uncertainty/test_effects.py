"""Effects of factorial designs: values by hand, coverage on simulated counts with a known truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Evidence, Resampler, Term, combine
from analysis.uncertainty.effects import Noise, estimate_effects
from analysis.uncertainty.intervals import over_images
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from tests.analysis.counts import counts_of

SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, -1, -1, 1]], float)
"""A, B and A x B of the cells A-B-, A-B+, A+B-, A+B+."""

NAMES = ("A", "B", "A x B")


def scores(values: object, drawn: object = None, images: int = 20) -> list[Evidence]:
    """Evidence of each cell from (S, C) values and (resamples, C) draws of the images."""
    array = np.array(values, float)
    draws = np.empty((0, array.shape[1])) if drawn is None else np.array(drawn, float)
    errors = [over_images(each, images) for each in draws.T]
    return [
        Evidence(
            values=tuple(array[:, cell].tolist()),
            seeds=tuple(range(len(array))),
            error=math.nan if errors[cell] is None else errors[cell].error,
            blocks=images,
            said="",
            drawn=draws[:, cell],
        )
        for cell in range(array.shape[1])
    ]


def test_effects_are_differences_of_halves() -> None:
    # Means of A are 9 and 2, of B 7.5 and 3.5. B adds 6 at A+ and 2 at A-: half of 4 is 2.
    cells = scores([[1, 3, 6, 12]])
    found = estimate_effects(cells, np.vstack([SIGNS, np.ones(4)]), "cells")
    assert [each.estimate.value for each in found] == [7, 4, 2, 5.5]
    assert all(each.estimate.both is None and not each.is_shown() for each in found)
    with pytest.raises(ValueError, match="balanced rows of 4"):
        estimate_effects(cells, np.array([[1.0, 1, 1, -1]]), "cells")


@pytest.mark.parametrize(
    ("values", "noise", "errors"),
    [
        # Seed 1 adds 10 to all cells and 1 to the last: left over are -+ 1/8 (three cells) and 3/8.
        # Sum of squares 2 (3/64 + 9/64) = 3/8 over (2 - 1)(4 - 1) = 3: variance 1/8.
        # An effect has weights -+ 1/2 over cells, means of two seeds: 1/8 x 4 x 1/4 / 2 = 1/16.
        ([[0, 0, 0, 0], [10, 10, 10, 11]], "cells", [0.25, 0.25, 0.25]),
        # Of the effect itself: 0 and 1/2, standard deviation 1 / (2 sqrt(2)), over sqrt(2): 1/4.
        ([[0, 0, 0, 0], [10, 10, 10, 11]], "effects", [0.25, 0.25, 0.25]),
        # A is 1 and 3, B and A x B are 0 in both seeds.
        ([[0, 0, 1, 1], [0, 0, 3, 3]], "effects", [1, 0, 0]),
    ],
)
def test_error_over_seeds_by_hand(values: object, noise: Noise, errors: list[float]) -> None:
    found = estimate_effects(scores(values), SIGNS, noise)
    spreads = [each.estimate.evidence.trainings for each in found]
    assert [each.error for each in spreads] == pytest.approx(errors)
    assert {each.freedom for each in spreads} == {3 if noise == "cells" else 1}


def test_error_of_images_is_of_the_draws_of_all_cells_together() -> None:
    # On draws A is 1 and 3: standard deviation 1, times sqrt(20 / 19).
    drawn: list[list[float]] = [[5, 5, 6, 6], [7, 7, 10, 10]]
    found = estimate_effects(scores([[0, 0, 2, 2], [0, 0, 2, 2]], drawn), SIGNS, "cells")
    assert found[0].estimate.evidence.error == pytest.approx(math.sqrt(20 / 19))
    assert found[1].estimate.evidence.error == 0


def test_combine_pairs_seeds_and_draws() -> None:
    one, two = scores([[3.0]], [[1.0], [2.0]])[0], scores([[1.0]], [[1.0], [0.0]])[0]
    found = combine((1.0, -1.0), (one, two))
    assert (found.values, found.drawn.tolist()) == ((2.0,), [0.0, 2.0])
    with pytest.raises(ValueError, match="the same seeds"):
        combine((1.0, -1.0), (one, replace(two, seeds=(4,))))


def counts(errors: np.ndarray, **changed: object) -> Counts:
    """(N, R) rates of error as counts of two classes of 1,000 pixels each per image and region."""
    wrong = np.rint(1000 * errors).astype(np.int64)
    matrices = np.stack(
        [np.stack([1000 - wrong, wrong], -1), np.stack([wrong, 1000 - wrong], -1)], -2
    )
    return counts_of(matrices, **changed)


def iou(error: float) -> float:
    """Of both classes: right / (2 x all - right) = (1 - e) / (1 + e), percent."""
    return 100 * (1 - error) / (1 + error)


def evidence(cells: list[dict[int, tuple[str, Counts]]], resamples: int = 100) -> list[Evidence]:
    """Region 1 less region 2 in every cell."""
    engine = Resampler(Resampling(resamples=resamples, blocks="none"), "names")
    found = []
    for cell in cells:
        keys, every = ({seed: each[n] for seed, each in cell.items()} for n in (0, 1))
        terms = [
            Term(weight=weight, metric=metric, counts=every, keys=keys)
            for metric, weight in (("region/1", 1.0), ("region/2", -1.0))
        ]
        found.append(engine.evidence(terms))
    return found


def test_cells_pair_images_by_name_and_may_have_other_labels() -> None:
    rates = np.random.default_rng(0).uniform(0.05, 0.3, (30, 2))
    names = [f"{n:05d}" for n in range(30)]
    mixed = np.random.default_rng(1).permutation(30)
    one = counts(rates, names=tuple(names))
    two = counts(rates[mixed], names=tuple(names[n] for n in mixed))
    two = replace(two, counts=two.counts * 2)
    first, second = evidence([{0: ("a", one)}, {0: ("b", two)}])
    assert first.drawn.tolist() == second.drawn.tolist()
    assert first.error > 0.1
    empty = replace(one, counts=np.zeros_like(one.counts), absent="exclude")
    with pytest.raises(InputError, match="run-b has nothing to score"):
        evidence([{0: ("run-b", empty)}])


TRUTH: Mapping[str, tuple[float, float]] = {
    "A-B-": (0.10, 0.10),
    "A-B+": (0.10, 0.10),
    "A+B-": (0.13, 0.10),
    "A+B+": (0.13, 0.10),
}
"""Rates of error of two regions: A makes region 1 worse; B and the interaction do nothing."""


def world(
    rng: np.random.Generator, noise: Noise, seeds: int = 3
) -> list[dict[int, tuple[str, Counts]]]:
    """Cells of 30 images: scenes shared by cells, and noise of every training.

    With "effects", a seed is one network whose response to A varies; it is the same in all cells.
    """
    scenes = rng.normal(0, 0.02, (30, 2))
    response = rng.normal(0, 0.004, seeds)
    cells: list[dict[int, tuple[str, Counts]]] = []
    for name, rates in TRUTH.items():
        cell = {}
        for seed in range(seeds):
            sign = 0.5 if "A+" in name else -0.5
            training = (
                rng.normal(0, 0.004, 2)
                if noise == "cells"
                else np.array([sign, -sign]) * response[seed]
            )
            own = rng.normal(0, 0.01, (30, 2))
            cell[seed] = (f"{name} {seed}", counts(np.clip(rates + scenes + training + own, 0, 1)))
        cells.append(cell)
    return cells


@pytest.mark.slow
@pytest.mark.parametrize(("noise", "seeds"), [("cells", 3), ("effects", 6)])
def test_intervals_cover_the_truth_and_null_effects_are_rarely_shown(
    noise: Noise, seeds: int
) -> None:
    rng = np.random.default_rng(11)
    truth = {"A": iou(0.13) - iou(0.10), "B": 0.0, "A x B": 0.0}
    trials, covered, shown = 300, dict.fromkeys(NAMES, 0), dict.fromkeys(NAMES, 0)
    for _ in range(trials):
        cells = evidence(world(rng, noise, seeds), 200)
        for name, found in zip(NAMES, estimate_effects(cells, SIGNS, noise), strict=True):
            assert found.estimate.both is not None
            covered[name] += truth[name] in found.estimate.both
            shown[name] += found.is_shown()
    # 300 trials: standard error 1.3 %. Rounded counts and the curve of the IoU cost little.
    assert all(0.91 <= covered[name] / trials <= 1.0 for name in NAMES), covered
    assert shown["B"] / trials <= 0.05
    assert shown["A x B"] / trials <= 0.05
    assert shown["A"] / trials >= 0.9, shown


def normal_scores(rng: np.random.Generator, effect: float, seeds: int) -> list[Evidence]:
    """Cells whose outcome is a mean over 40 images; the first contrast has the given effect."""
    truth = SIGNS[0] * effect / 2
    images = rng.normal(0, 2, (40, 4)) + rng.normal(0, 3, (40, 1))
    trainings = rng.normal(0, 1, (seeds, 4)) + rng.normal(0, 5, (seeds, 1))
    drawn = rng.multinomial(40, np.full(40, 1 / 40), 200) / 40 @ images
    return scores(truth + images.mean(0) + trainings, drawn, 40)


@pytest.mark.parametrize("seeds", [2, 4])
def test_intervals_of_cells_cover_normal_truths(seeds: int) -> None:
    rng = np.random.default_rng([5, seeds])
    trials = [estimate_effects(normal_scores(rng, 2.0, seeds), SIGNS, "cells") for _ in range(600)]
    covered = [0, 0, 0]
    for found in trials:
        for number, truth in enumerate((2.0, 0.0, 0.0)):
            interval = found[number].estimate.both
            assert interval is not None
            covered[number] += truth in interval
    # Standard error 0.9 %.
    assert all(0.93 <= count / 600 <= 0.985 for count in covered), covered
    family = np.mean([t[1].is_shown() or t[2].is_shown() for t in trials])
    assert family <= 0.05
