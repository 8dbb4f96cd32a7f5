"""Effects of factorial designs: values by hand, coverage on simulated counts with a known truth."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling
from analysis.uncertainty.factorial import (
    CellScorer,
    CellScores,
    Noise,
    estimate_effects,
    estimate_mean,
)
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from tests.analysis.counts import counts_of

SIGNS = np.array([[-1, -1, 1, 1], [-1, 1, -1, 1], [1, -1, -1, 1]], float)
"""A, B and A x B of the cells A-B-, A-B+, A+B-, A+B+."""

NAMES = ("A", "B", "A x B")


def scores(values: list[list[float]], drawn: list[list[float]] | None = None) -> CellScores:
    array = np.array(values, float)
    empty = np.zeros((0, array.shape[1]))
    return CellScores(
        values=array,
        drawn=empty if drawn is None else np.array(drawn, float),
        images=20,
        seeds=tuple(range(len(array))),
    )


def test_effects_are_differences_of_halves() -> None:
    # Means of A are 9 and 2, of B 7.5 and 3.5. B adds 6 at A+ and 2 at A-: half of 4 is 2.
    found = estimate_effects(scores([[1, 3, 6, 12]]), SIGNS, "cells")
    assert [each.value for each in found] == [7, 4, 2]
    assert all(each.interval is None and not each.is_shown() for each in found)
    assert estimate_mean(scores([[1, 3, 6, 12]])).value == 5.5


def test_error_of_cells_is_what_means_of_seeds_and_cells_leave() -> None:
    # Seed 1 adds 10 to all cells and 1 to the last: left over are -+ 1/8 (three cells) and 3/8.
    # Sum of squares 2 (3/64 + 9/64) = 3/8 over (2 - 1)(4 - 1) = 3: variance 1/8.
    # An effect has weights -+ 1/2 over cells, means of two seeds: 1/8 x 4 x 1/4 / 2 = 1/16.
    found = estimate_effects(scores([[0, 0, 0, 0], [10, 10, 10, 11]]), SIGNS, "cells")
    assert [each.of_seeds for each in found] == pytest.approx([0.25, 0.25, 0.25])
    # Of the effect itself: 0 and 1/2, standard deviation 1 / (2 sqrt(2)), over sqrt(2): 1/4.
    found = estimate_effects(scores([[0, 0, 0, 0], [10, 10, 10, 11]]), SIGNS, "effects")
    assert [each.of_seeds for each in found] == pytest.approx([0.25, 0.25, 0.25])


def test_error_of_effects_is_of_each_effect() -> None:
    # A is 1 and 3, B and A x B are 0 in both seeds.
    found = estimate_effects(scores([[0, 0, 1, 1], [0, 0, 3, 3]]), SIGNS, "effects")
    assert [each.of_seeds for each in found] == pytest.approx([1, 0, 0])


def test_error_of_images_is_of_the_draws_of_all_cells_together() -> None:
    # On draws A is 1 and 3: standard deviation 1, times sqrt(20 / 19).
    drawn: list[list[float]] = [[5, 5, 6, 6], [7, 7, 10, 10]]
    found = estimate_effects(scores([[0, 0, 2, 2], [0, 0, 2, 2]], drawn), SIGNS, "cells")
    assert found[0].of_images == pytest.approx(math.sqrt(20 / 19))
    assert found[1].of_images == 0


def test_effects_refuses_unbalanced_contrasts() -> None:
    with pytest.raises(ValueError, match="balanced rows of 4"):
        estimate_effects(scores([[1, 2, 3, 4]]), np.array([[1.0, 1, 1, -1]]), "cells")


def test_less_pairs_seeds_and_draws() -> None:
    one, two = scores([[3, 4]], [[1, 2]]), scores([[1, 1]], [[1, 0]])
    found = one.less(two)
    assert found.values.tolist() == [[2, 3]]
    assert found.drawn.tolist() == [[0, 2]]
    with pytest.raises(ValueError, match="the same seeds"):
        one.less(replace(two, seeds=(4,)))


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


SCORER = {"region/1": 1.0, "region/2": -1.0}


def test_scorer_takes_contrasts_of_regions() -> None:
    cells = [{0: ("a", counts(np.full((12, 2), rate)))} for rate in (0.1, 0.2)]
    cells[1][0] = ("b", counts(np.tile([0.2, 0.1], (12, 1))))
    found = CellScorer(Resampling(resamples=100, blocks="none")).cells(SCORER, cells, (0,))
    assert found.values[0].tolist() == pytest.approx([0, iou(0.2) - iou(0.1)])
    assert found.drawn.shape == (100, 2)
    assert found.drawn.std(0).tolist() == pytest.approx([0, 0])  # all images are equal


def test_scorer_pairs_images_by_name() -> None:
    rates = np.random.default_rng(0).uniform(0.05, 0.3, (30, 2))
    names = [f"{n:05d}" for n in range(30)]
    mixed = np.random.default_rng(1).permutation(30)
    one = counts(rates, names=tuple(names))
    two = counts(rates[mixed], names=tuple(names[n] for n in mixed))
    found = CellScorer(Resampling(resamples=100, blocks="none")).cells(
        SCORER, [{0: ("a", one)}, {0: ("b", two)}], (0,)
    )
    assert found.drawn[:, 0].tolist() == found.drawn[:, 1].tolist()
    assert found.drawn[:, 0].std() > 0.1


@pytest.mark.parametrize(
    ("changed", "what"),
    [({"classes": ("a", "b")}, "classes"), ({"names": tuple("abcdefghijkl")}, "images")],
)
def test_scorer_refuses_other_images_and_classes(changed: dict[str, object], what: str) -> None:
    rates = np.full((12, 2), 0.1)
    cells = [{0: ("a", counts(rates))}, {0: ("b", counts(rates, **changed))}]
    with pytest.raises(InputError, match=f"counts of the same {what}"):
        CellScorer(Resampling(resamples=100, blocks="none")).cells(SCORER, cells, (0,))


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
        scorer = CellScorer(Resampling(resamples=200, blocks="none"))
        cells = scorer.cells(SCORER, world(rng, noise, seeds), range(seeds))
        for name, found in zip(NAMES, estimate_effects(cells, SIGNS, noise), strict=True):
            assert found.interval is not None
            covered[name] += truth[name] in found.interval
            shown[name] += found.is_shown()
    # 300 trials: standard error 1.3 %. Rounded counts and the curve of the IoU cost little.
    assert all(0.91 <= covered[name] / trials <= 1.0 for name in NAMES), covered
    assert shown["B"] / trials <= 0.05
    assert shown["A x B"] / trials <= 0.05
    assert shown["A"] / trials >= 0.9, shown


def normal_scores(rng: np.random.Generator, effect: float, seeds: int) -> CellScores:
    """Cells whose outcome is a mean over 40 images; the first contrast has the given effect."""
    truth = SIGNS[0] * effect / 2
    images = rng.normal(0, 2, (40, 4)) + rng.normal(0, 3, (40, 1))
    trainings = rng.normal(0, 1, (seeds, 4)) + rng.normal(0, 5, (seeds, 1))
    drawn = rng.multinomial(40, np.full(40, 1 / 40), 200) / 40 @ images
    return CellScores(
        values=truth + images.mean(0) + trainings,
        drawn=drawn,
        images=40,
        seeds=tuple(range(seeds)),
    )


@pytest.mark.parametrize("seeds", [2, 4])
def test_intervals_of_cells_cover_normal_truths(seeds: int) -> None:
    rng = np.random.default_rng([5, seeds])
    trials = [estimate_effects(normal_scores(rng, 2.0, seeds), SIGNS, "cells") for _ in range(600)]
    covered = [0, 0, 0]
    for found in trials:
        for number, truth in enumerate((2.0, 0.0, 0.0)):
            interval = found[number].interval
            assert interval is not None
            covered[number] += truth in interval
    # Standard error 0.9 %.
    assert all(0.93 <= count / 600 <= 0.985 for count in covered), covered
    family = np.mean([t[1].is_shown() or t[2].is_shown() for t in trials])
    assert family <= 0.05


def test_scorer_names_counts_without_anything_to_score() -> None:
    full = counts(np.full((12, 2), 0.1), absent="exclude")
    empty = replace(full, counts=np.zeros_like(full.counts))
    scorer = CellScorer(Resampling(resamples=100, blocks="none"))
    with pytest.raises(InputError, match="run-b has nothing to score"):
        scorer.cells(SCORER, [{0: ("run-a", full)}, {0: ("run-b", empty)}], (0,))
