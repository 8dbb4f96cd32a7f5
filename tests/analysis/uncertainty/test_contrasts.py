"""Evidence about contrasts, against a bootstrap written as a loop."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling
from analysis.uncertainty.blocks import ImageBlocks
from analysis.uncertainty.contrasts import FIXED, Resampler, Term
from analysis.uncertainty.estimates import estimate_of
from analysis.uncertainty.verdicts import Rule, decide
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of
from tests.measured import remeasured

SETTINGS = Resampling(resamples=120, blocks="none")
METRICS = ("mIoU", "Var", "region/2", "class/car", "class/person/region/1", "pixel_accuracy")


def rows_of(images: int = 30, seeds: int = 3, **changed: object) -> list[dict[int, Counts]]:
    """Two rows on the same images, the second one better."""
    population = Population(training_sd=0.1)
    rng = np.random.default_rng(0)
    arrays = population.pair(rng, images, seeds, Population(skill=1.8, training_sd=0.1))
    return [
        {seed: counts_of(array, **changed) for seed, array in enumerate(of_row)}
        for of_row in arrays
    ]


def term(weight: float, row: Mapping[int, Counts], name: str, metric: str = "mIoU") -> Term:
    keys = {seed: f"{name}/{seed}" for seed in row}
    return Term(weight=weight, metric=metric, counts=row, keys=keys)


def difference(rows: Sequence[Mapping[int, Counts]], metric: str = "mIoU") -> list[Term]:
    return [term(1.0, rows[1], "b", metric), term(-1.0, rows[0], "a", metric)]


def by_loop(terms: Sequence[Term], seeds: Sequence[int]) -> tuple[np.ndarray, float]:
    """Values by seed, and the error over single images, score by score."""

    def scored(images: np.ndarray) -> np.ndarray:
        total = np.zeros(len(seeds))
        for term in terms:
            for place, seed in enumerate(seeds):
                counts = term.counts[FIXED if term.fixed else seed]
                drawn = replace(counts, counts=counts.counts * images[:, None, None, None])
                total[place] += term.weight * value(term.metric, drawn, "released")
        return total

    count = len(next(iter(terms[0].counts.values())).names)
    rng = numpy_generator(SETTINGS.seed, "bootstrap")
    draws = rng.multinomial(count, np.full(count, 1 / count), SETTINGS.resamples)
    means = [scored(names).mean() for names in draws]
    return scored(np.ones(count, int)), float(np.std(means))


def regions(rows: Sequence[Mapping[int, Counts]]) -> list[Term]:
    """The centre gains more than the edge."""
    minus = [replace(term, weight=-term.weight) for term in difference(rows, "region/2")]
    return [*difference(rows, "region/1"), *minus]


def with_pairs(rows: Sequence[Mapping[int, Counts]]) -> list[Term]:
    views = {seed: pairs_of(30, 0.8, seed) for seed in rows[0]}
    return [term(1.0, rows[0], "frames"), term(-1.0, views, "pairs", "TC")]


def with_fixed(rows: Sequence[Mapping[int, Counts]]) -> list[Term]:
    return [term(1.0, {FIXED: rows[1][0]}, "folder"), term(-1.0, rows[0], "a")]


@pytest.mark.parametrize("make", [*METRICS, regions, with_pairs, with_fixed])
def test_evidence_equals_a_loop_over_resamples(make: object) -> None:
    terms = difference(rows_of(), make) if isinstance(make, str) else make(rows_of())
    found = Resampler(SETTINGS).evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(30 / 29))
    assert (found.seeds, found.blocks, found.said) == ((0, 1, 2), 30, "30 single images")


@pytest.mark.parametrize("blocks", ["none", "auto", 3])
def test_evidence_gives_the_interval_of_paired_comparisons(blocks) -> None:
    """Scenes of four neighbours, so that "auto" draws blocks."""
    rng = np.random.default_rng(2)
    arrays = Population(block=4).pair(rng, 60, 4, Population(skill=1.8, training_sd=0.1))
    rows = [dict(enumerate(map(counts_of, of_row))) for of_row in arrays]
    settings = replace(SETTINGS, blocks=blocks)
    found = Resampler(settings).evidence(difference(rows, "Var"))
    wanted = estimate_of(found, settings.level)
    assert ("neighbouring frames" in found.said) == (blocks != "none")
    verdict = decide([found], (0.0, math.inf), Rule(), "all")
    assert verdict.interval is not None
    assert (verdict.interval.low, verdict.interval.high, verdict.estimate) == pytest.approx(
        (wanted.interval.low, wanted.interval.high, wanted.value)
    )


def test_evidence_of_the_night_gives_other_images_no_weight() -> None:
    """18 of 30 images by night: the draws are those of all images."""
    rows = rows_of(night=tuple(place % 5 < 3 for place in range(30)))
    terms = difference(rows, "night/mIoU")
    for chosen in (terms, [*terms, *difference(rows, "mIoU")]):
        found = Resampler(SETTINGS).evidence(chosen)
        values, error = by_loop(chosen, (0, 1, 2))
        assert found.values == pytest.approx(values)
        assert found.error == pytest.approx(error * math.sqrt(18 / 17))
        assert (found.blocks, found.said) == (18, "18 of 30 single images")


def test_evidence_terms_may_have_other_regions() -> None:
    """The same predictions in one region and in two have the same mIoU on every draw."""
    row, _ = rows_of()
    whole = {
        seed: remeasured(replace(five, counts=five.counts.sum(1, keepdims=True)), partition="ring1")
        for seed, five in row.items()
    }
    found = Resampler(SETTINGS).evidence([term(1.0, row, "two"), term(-1.0, whole, "one")])
    assert (found.values, found.error) == ((0.0, 0.0, 0.0), 0.0)


def test_evidence_uses_the_seeds_that_all_rows_have() -> None:
    row, other = rows_of(seeds=4)
    first = {seed: row[seed] for seed in (0, 2, 3)}
    second = {seed: other[seed] for seed in (3, 1, 2)}
    found = Resampler(SETTINGS).evidence(difference([first, second]))
    whole = Resampler(SETTINGS).evidence(difference([row, other]))
    assert (found.seeds, found.values) == ((2, 3), whole.values[2:])
    fixed = [term(1.0, {FIXED: other[0]}, "b"), term(-1.0, {FIXED: row[0]}, "a")]
    found = Resampler(SETTINGS).evidence(fixed)
    assert (found.seeds, len(found.values)) == ((), 1)


def test_evidence_ignores_order_of_images_and_other_contrasts() -> None:
    rows = rows_of()
    names = np.random.default_rng(1).permutation(rows[0][0].names).tolist()
    shuffled = [{seed: counts.select(names) for seed, counts in row.items()} for row in rows]
    settings = replace(SETTINGS, blocks="auto")
    plain = Resampler(settings).evidence(difference(rows))
    used = Resampler(settings)
    used.evidence([term(1.0, rows[0], "a", "Var")])
    used.evidence([term(1.0, rows[0], "a")])
    assert used.evidence(difference(rows)) == plain
    assert Resampler(settings).evidence(difference(shuffled)) == plain


def test_scores_share_only_the_draws_of_what_they_read() -> None:
    rows, used = rows_of(), Resampler(SETTINGS)
    for metric in ("class/car", "mIoU", "Var", "region/2", "pixel_accuracy"):
        terms = difference(rows, metric)
        assert used.evidence(terms) == Resampler(SETTINGS).evidence(terms)


def test_evidence_again_draws_no_images(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, resampler, calls = rows_of(), Resampler(SETTINGS), []
    draw = ImageBlocks.draws
    monkeypatch.setattr(ImageBlocks, "draws", lambda *given: calls.append(1) or draw(*given))
    less = [{seed: row[seed] for seed in (0, 1)} for row in rows]
    first = resampler.evidence(difference(less))
    more = resampler.evidence(difference(rows))
    assert len(calls) == 4
    assert resampler.evidence(difference(rows)) == more
    assert len(calls) == 4
    assert more.values[:2] == first.values


def test_evidence_of_too_few_images_raises_no_error() -> None:
    found = Resampler(SETTINGS).evidence(difference(rows_of(9)))
    assert (len(found.values), found.blocks) == (3, 9)
    assert math.isnan(found.error)


def test_what_cannot_be_compared_is_refused() -> None:
    row, other = rows_of()

    def refused(terms: list[Term], word: str) -> None:
        with pytest.raises(InputError, match=word):
            Resampler(SETTINGS).evidence(terms)

    apart = [{0: row[0]}, {1: other[1], 2: other[2]}]
    refused(difference(apart), "no seed in common: 1, 2 and 0. Train the same seeds")
    emptied = {seed: replace(full, counts=full.counts * 0) for seed, full in row.items()}
    word = "'pixel_accuracy' of one of a/0, a/1, a/2 has nothing to score"
    refused([term(1.0, emptied, "a", "pixel_accuracy")], word)
    for keys, counts in (({0: "a"}, row), ({FIXED: "a", 1: "b"}, {FIXED: row[0], 1: row[1]})):
        with pytest.raises(ValueError, match="expected counts and keys of one seed or more"):
            Term(weight=1.0, metric="mIoU", counts=counts, keys=keys)


def test_folds_are_resampled_over_the_images_of_all_of_them() -> None:
    """A seed tested on some images is one whose other counts are 0, whatever is drawn."""
    rows = rows_of(images=24, seeds=3)
    names = rows[0][0].names
    folds = {0: names[:12], 1: names[12:], 2: names[6:18]}
    parts = [{seed: row[seed].select(folds[seed]) for seed in row} for row in rows]
    filled = []
    for row in rows:
        filled.append({})
        for seed, counts in row.items():
            used = np.array([name in folds[seed] for name in names])
            zeroed = counts.counts * used[:, None, None, None]
            filled[-1][seed] = replace(counts, counts=zeroed)
    engine = Resampler(SETTINGS)
    for metric in ("mIoU", "region/2"):
        found = engine.contrast(difference(parts, metric))
        expected, error = by_loop(difference(filled, metric), (0, 1, 2))
        assert found.values == pytest.approx(expected.tolist())
        assert found.error == pytest.approx(error * math.sqrt(24 / 23))
        assert found.blocks == len(names)
    # Both pairs of folds have 18 images, and seed 2 in common, but other images.
    for pair in ((0, 2), (1, 2)):
        some = difference([{seed: row[seed] for seed in pair} for row in parts])
        alone = Resampler(SETTINGS).contrast(some)
        assert engine.contrast(some).error == pytest.approx(alone.error)
        assert alone.blocks == 18
    other = [{**row, 1: replace(row[1], unscored=("person",))} for row in parts]
    with pytest.raises(InputError, match="mean"):
        Resampler(SETTINGS).contrast(difference(other))
    parts[0][1] = rows[0][1].select(folds[0])
    with pytest.raises(InputError, match="not of the same images"):
        Resampler(SETTINGS).contrast(difference(parts))
