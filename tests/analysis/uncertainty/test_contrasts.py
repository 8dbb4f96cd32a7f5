"""Evidence about contrasts, against a bootstrap written as a loop."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pytest

from analysis.uncertainty import Resampling, compare
from analysis.uncertainty.blocks import ImageBlocks
from analysis.uncertainty.contrasts import FIXED, Evidence, Resampler, Term
from analysis.uncertainty.verdicts import FixedSeeds, decide
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from rgbt.randomness import numpy_generator
from tests.analysis.uncertainty.simulated import Population, counts_of, pairs_of

SETTINGS = Resampling(resamples=120, blocks="none")
METRICS = ("mIoU", "Var", "region/2", "class/car", "class/person/region/1", "pixel_accuracy")


def rows_of(images: int = 30, seeds: int = 3, **changed: object) -> list[dict[int, Counts]]:
    """Two rows on the same images, the second one better."""
    population = Population(training_sd=0.1)
    rng = np.random.default_rng(0)
    arrays = population.pair(rng, images, seeds, Population(skill=1.8, training_sd=0.1))
    return [
        {seed: counts_of(array, **changed) for seed, array in enumerate(each)} for each in arrays
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
        for each in terms:
            for place, seed in enumerate(seeds):
                counts = each.counts[FIXED if each.fixed else seed]
                drawn = replace(counts, counts=counts.counts * images[:, None, None, None])
                total[place] += each.weight * value(each.metric, drawn, "released")
        return total

    count = len(next(iter(terms[0].counts.values())).names)
    rng = numpy_generator(SETTINGS.seed, "bootstrap")
    draws = rng.multinomial(count, np.full(count, 1 / count), SETTINGS.resamples)
    means = [scored(each).mean() for each in draws]
    return scored(np.ones(count, int)), float(np.std(means))


@pytest.mark.parametrize("metric", METRICS)
def test_evidence_equals_a_loop_over_resamples(metric: str) -> None:
    terms = difference(rows_of(), metric)
    found = Resampler(SETTINGS).evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(30 / 29))
    assert (found.seeds, found.blocks, found.said) == ((0, 1, 2), 30, "30 single images")


def test_evidence_of_two_differences_equals_a_loop() -> None:
    """The centre gains more than the edge."""
    rows = rows_of()
    terms = [
        term(weight * sign, row, name, f"region/{region}")
        for weight, region in ((1.0, 1), (-1.0, 2))
        for sign, row, name in ((1.0, rows[1], "b"), (-1.0, rows[0], "a"))
    ]
    found = Resampler(SETTINGS).evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(30 / 29))


@pytest.mark.parametrize("blocks", ["none", "auto", 3])
@pytest.mark.parametrize("metric", ["mIoU", "Var", "region/1"])
def test_evidence_gives_the_interval_of_paired_comparisons(blocks, metric: str) -> None:
    """Scenes of four neighbours, so that "auto" draws blocks."""
    rng = np.random.default_rng(2)
    arrays = Population(block=4).pair(rng, 60, 4, Population(skill=1.8, training_sd=0.1))
    rows = [dict(enumerate(map(counts_of, each))) for each in arrays]
    settings = replace(SETTINGS, blocks=blocks)
    (wanted,) = compare(
        *(list(row.values()) for row in rows), [metric], settings, paired=True
    ).differences
    found = Resampler(settings).evidence(difference(rows, metric))
    both = wanted.difference.both
    assert both is not None
    if blocks == "auto":
        assert "neighbouring frames" in found.said
    verdict = decide([found], (0.0, math.inf), FixedSeeds(), "all")
    assert verdict.interval is not None
    assert verdict.interval.low == pytest.approx(both.low)
    assert verdict.interval.high == pytest.approx(both.high)
    assert verdict.estimate == pytest.approx(wanted.value)


def test_evidence_of_the_night_gives_other_images_no_weight() -> None:
    """18 of 30 images by night: the draws are those of all images."""
    night = tuple(place % 5 < 3 for place in range(30))
    terms = difference(rows_of(night=night), "night/mIoU")
    resampler = Resampler(SETTINGS)
    found = resampler.evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(18 / 17))
    assert (found.blocks, found.said) == (18, "18 of 30 single images")
    both = [*terms, *difference(rows_of(night=night), "mIoU")]
    values, error = by_loop(both, (0, 1, 2))
    found = resampler.evidence(both)
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(18 / 17))


def test_evidence_of_the_night_without_nights_is_refused() -> None:
    with pytest.raises(InputError, match="does not contain both images marked as day"):
        Resampler(SETTINGS).evidence(difference(rows_of(), "night/mIoU"))


def test_evidence_terms_may_have_other_regions() -> None:
    """The same predictions in one region and in two have the same mIoU on every draw."""
    row, _ = rows_of()
    whole = {
        seed: replace(each, counts=each.counts.sum(1, keepdims=True), partition="ring1")
        for seed, each in row.items()
    }
    found = Resampler(SETTINGS).evidence([term(1.0, row, "two"), term(-1.0, whole, "one")])
    assert found.values == (0.0, 0.0, 0.0)
    assert found.error == 0.0


def test_evidence_joins_single_frames_and_pairs_of_frames() -> None:
    row, _ = rows_of()
    views = {seed: pairs_of(30, 0.8, seed) for seed in row}
    terms = [term(1.0, row, "frames"), term(-1.0, views, "pairs", "TC")]
    found = Resampler(SETTINGS).evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(30 / 29))


def test_evidence_pairs_a_fixed_method_with_every_seed() -> None:
    row, other = rows_of()
    fixed = {FIXED: other[0]}
    terms = [term(1.0, fixed, "folder"), term(-1.0, row, "a")]
    found = Resampler(SETTINGS).evidence(terms)
    values, error = by_loop(terms, (0, 1, 2))
    assert found.seeds == (0, 1, 2)
    assert found.values == pytest.approx(values)
    assert found.error == pytest.approx(error * math.sqrt(30 / 29))


def test_evidence_of_fixed_methods_alone_has_one_value_and_no_seeds() -> None:
    row, other = rows_of()
    terms = [term(1.0, {FIXED: other[0]}, "b"), term(-1.0, {FIXED: row[0]}, "a")]
    found = Resampler(SETTINGS).evidence(terms)
    (wanted,) = compare([row[0]], [other[0]], ["mIoU"], SETTINGS).differences
    assert found.seeds == ()
    assert found.values == pytest.approx([wanted.value])
    assert decide([found], (0.0, math.inf), FixedSeeds(), "all").covers == "images"


def test_evidence_uses_the_seeds_that_all_rows_have() -> None:
    row, other = rows_of(seeds=4)
    first = {seed: row[seed] for seed in (0, 2, 3)}
    second = {seed: other[seed] for seed in (3, 1, 2)}
    found = Resampler(SETTINGS).evidence(difference([first, second]))
    whole = Resampler(SETTINGS).evidence(difference([row, other]))
    assert found.seeds == (2, 3)
    assert found.values == whole.values[2:]


def test_evidence_does_not_depend_on_the_order_of_images_or_on_other_contrasts() -> None:
    rows = rows_of()
    names = np.random.default_rng(1).permutation(rows[0][0].names).tolist()
    shuffled = [{seed: each.select(names) for seed, each in row.items()} for row in rows]
    settings = replace(SETTINGS, blocks="auto")
    plain = Resampler(settings).evidence(difference(rows))
    used = Resampler(settings)
    used.evidence([term(1.0, rows[0], "a", "Var")])
    used.evidence([term(1.0, rows[0], "a")])
    assert used.evidence(difference(rows)) == plain
    assert Resampler(settings).evidence(difference(shuffled)) == plain


def test_evidence_again_draws_no_images(monkeypatch: pytest.MonkeyPatch) -> None:
    rows, resampler, calls = rows_of(), Resampler(SETTINGS), []
    draw = ImageBlocks.draws

    def counted(self: ImageBlocks, settings: Resampling) -> object:
        calls.append(self.count)
        return draw(self, settings)

    monkeypatch.setattr(ImageBlocks, "draws", counted)
    less = [{seed: row[seed] for seed in (0, 1)} for row in rows]
    first = resampler.evidence(difference(less))
    more = resampler.evidence(difference(rows))
    assert calls == [30] * 4
    assert resampler.evidence(difference(rows)) == more
    assert calls == [30] * 4
    assert more.values[:2] == first.values


def test_evidence_of_too_few_images_has_values_and_no_error() -> None:
    found = Resampler(SETTINGS).evidence(difference(rows_of(9)))
    assert len(found.values) == 3
    assert math.isnan(found.error)
    assert found.blocks == 9


def test_evidence_of_the_mean_contrast_has_divided_weights() -> None:
    rows, resampler = rows_of(), Resampler(SETTINGS)
    single = [resampler.evidence(difference(rows, f"region/{number}")) for number in (1, 2)]
    terms = [
        replace(each, weight=each.weight / 2)
        for number in (1, 2)
        for each in difference(rows, f"region/{number}")
    ]
    found = resampler.evidence(terms)
    assert found.values == pytest.approx(np.mean([each.values for each in single], axis=0))
    assert isinstance(found, Evidence)
    assert decide([found], (0.0, math.inf), FixedSeeds(), "mean").estimate == pytest.approx(
        np.mean([each.values for each in single])
    )


def test_evidence_refuses_what_cannot_be_compared() -> None:
    (row, other), resampler = rows_of(), Resampler(SETTINGS)
    with pytest.raises(InputError, match="no seed in common: 1, 2 and 0. Train the same seeds"):
        resampler.evidence(difference([{0: row[0]}, {1: other[1], 2: other[2]}]))
    foreign = {
        seed: replace(each, names=tuple(f"x{n}" for n in range(30))) for seed, each in row.items()
    }
    with pytest.raises(InputError, match="the counts are not of the same images"):
        Resampler(SETTINGS).evidence(difference([row, foreign]))
    relabelled = {seed: replace(each, counts=each.counts * 2) for seed, each in row.items()}
    with pytest.raises(InputError, match="has different labels in the two counts"):
        Resampler(SETTINGS).evidence(difference([row, relabelled]))
    with pytest.raises(InputError, match="'class/tree'"):
        resampler.evidence(difference([row, other], "class/tree"))
    with pytest.raises(InputError, match="the counts have the regions 1 to 2"):
        resampler.evidence(difference([row, other], "region/3"))
    emptied = {seed: replace(each, counts=each.counts * 0) for seed, each in row.items()}
    with pytest.raises(
        InputError, match="'pixel_accuracy' of one of a/0, a/1, a/2 has nothing to score"
    ):
        Resampler(SETTINGS).evidence([term(1.0, emptied, "a", "pixel_accuracy")])
    with pytest.raises(ValueError, match="expected one term or more"):
        resampler.evidence([])


def test_term_wrong_seeds_are_refused() -> None:
    row, _ = rows_of()
    with pytest.raises(ValueError, match="expected counts of one seed or more, and a key for each"):
        Term(weight=1.0, metric="mIoU", counts=row, keys={0: "a"})
    with pytest.raises(ValueError, match="either counts by seed or fixed counts, got both"):
        term(1.0, {FIXED: row[0], 1: row[1]}, "a")
