"""Effects of factorial designs: values by hand, coverage on simulated counts with a known truth."""

from __future__ import annotations

import math
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
    """Evidence of effect cell from (S, C) values and (resamples, C) draws of the images."""
    array = np.array(values, float)
    draws = np.empty((0, array.shape[1])) if drawn is None else np.array(drawn, float)
    errors = [over_images(drawn, images) for drawn in draws.T]
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
    assert [effect.value for effect in found] == [7, 4, 2, 5.5]
    assert all(effect.both is None and not effect.is_shown() for effect in found)
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
    spreads = [effect.evidence.trainings for effect in found]
    assert [spread.error for spread in spreads] == pytest.approx(errors)
    assert {spread.freedom for spread in spreads} == {3 if noise == "cells" else 1}


def test_error_of_images_uses_joint_draws_of_all_cells() -> None:
    # On draws A is 1 and 3: standard deviation 1, times sqrt(20 / 19).
    drawn: list[list[float]] = [[5, 5, 6, 6], [7, 7, 10, 10]]
    found = estimate_effects(scores([[0, 0, 2, 2], [0, 0, 2, 2]], drawn), SIGNS, "cells")
    assert found[0].evidence.error == pytest.approx(math.sqrt(20 / 19))
    assert found[1].evidence.error == 0


def test_combine_pairs_seeds_and_draws() -> None:
    one, two = scores([[3.0]], [[1.0], [2.0]])[0], scores([[1.0]], [[1.0], [0.0]])[0]
    found = combine((1.0, -1.0), (one, two))
    assert (found.values, found.drawn.tolist()) == ((2.0,), [0.0, 2.0])
    with pytest.raises(ValueError, match="the same seeds"):
        combine((1.0, -1.0), (one, replace(two, seeds=(4,))))


def test_cells_pair_images_by_name_whatever_their_labels() -> None:
    names, mixed = [f"{n:05d}" for n in range(30)], np.random.default_rng(1).permutation(30)
    array = np.random.default_rng(0).integers(1, 900, (30, 2, 2, 2))
    engine = Resampler(Resampling(resamples=100, blocks="none"), "names")

    def cell(key: str, counts: Counts) -> Evidence:
        """Region 1 less region 2."""
        given = {"counts": {0: counts}, "keys": {0: key}}
        return engine.evidence(
            [
                Term(weight=1.0, metric="region/1", **given),
                Term(weight=-1.0, metric="region/2", **given),
            ]
        )

    first = cell("a", counts_of(array, names=tuple(names)))
    second = cell("b", counts_of(2 * array[mixed], names=tuple(names[n] for n in mixed)))
    assert first.drawn.tolist() == second.drawn.tolist()
    assert first.error > 0.1
    empty = counts_of(0 * array, names=tuple(names), absent="exclude")
    with pytest.raises(InputError, match="run-b has nothing to score"):
        cell("run-b", empty)


def normal_scores(rng: np.random.Generator, noise: Noise, seeds: int) -> list[Evidence]:
    """Cells whose outcome is a mean over 40 images; the first contrast has the effect 2.

    With "effects", a seed is one network whose response to the first factor varies.
    """
    images = rng.normal(0, 2, (40, 4)) + rng.normal(0, 3, (40, 1))
    trainings = rng.normal(0, 1, (seeds, 4)) + rng.normal(0, 5, (seeds, 1))
    if noise == "effects":
        trainings = SIGNS[0] * rng.normal(0, 1, (seeds, 1)) + rng.normal(0, 5, (seeds, 1))
    drawn = rng.multinomial(40, np.full(40, 1 / 40), 200) / 40 @ images
    return scores(SIGNS[0] + images.mean(0) + trainings, drawn, 40)


@pytest.mark.parametrize(("noise", "seeds"), [("cells", 2), ("cells", 4), ("effects", 4)])
def test_intervals_cover_truth_and_rarely_show_null_effects(noise: Noise, seeds: int) -> None:
    rng, covered, shown = np.random.default_rng([5, seeds]), np.zeros(3), 0
    for _ in range(200):
        found = estimate_effects(normal_scores(rng, noise, seeds), SIGNS, noise)
        covered += [truth in effect.both for truth, effect in zip((2, 0, 0), found, strict=True)]
        shown += any(effect.is_shown() for effect in found[1:])
    # Standard error 1.5 %.
    assert (covered / 200 >= 0.9).all(), covered
    assert covered[0] / 200 <= 0.99
    assert shown / 200 <= 0.075
