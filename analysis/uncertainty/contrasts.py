"""The one engine of intervals: a contrast is a weighted sum of scores of runs.

A score with its interval is a contrast of one term, a comparison one of two, a claim of a paper one
of its cells, a factorial effect one of all cells of a design. Blocks of images are drawn anew, the
same for all terms, so that what an image does to all of them cancels. The runs (seeds) are few:
their spread is Student's or that of a confidence sequence, and not that of a bootstrap over tasks
as in rliable (Agarwal et al., NeurIPS 2021).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.uncertainty.blocks import FEWEST, ImageBlocks, Resampling, make_blocks
from analysis.uncertainty.intervals import Spread, Values, over_images, over_seeds
from analysis.uncertainty.same_images import Alike, in_order
from analysis.uncertainty.scores import RunScores, watched
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts, convention
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import images_of, parse

FIXED = -1
"""Seed of counts that belong to no seed: a folder of predictions, one file of weights."""


@dataclass(frozen=True, kw_only=True)
class Term:
    """One score in a linear contrast.

    Attributes:
        metric: see `rgbt.metrics.named`.
        counts: by seed; the same images in all terms. `{FIXED: counts}` for a method without seeds.
        keys: by seed, identity of the counts: equal keys, equal counts.

    Raises:
        ValueError: no counts, other seeds in `keys`, or `FIXED` beside seeds.
    """

    weight: float
    metric: str
    counts: Mapping[int, Counts]
    keys: Mapping[int, str]

    def __post_init__(self) -> None:
        if not self.counts or set(self.counts) != set(self.keys):
            raise ValueError("term: expected counts of one seed or more, and a key for each.")
        if FIXED in self.counts and len(self.counts) > 1:
            raise ValueError("term: expected either counts by seed or fixed counts, got both.")

    @property
    def fixed(self) -> bool:
        """Whether it has no seeds."""
        return FIXED in self.counts


@dataclass(frozen=True, kw_only=True)
class Evidence:
    """What the data say about one contrast.

    Attributes:
        values: contrast of each seed that all terms with seeds have; of fixed terms alone, and of
            methods whose seeds are not paired, one value. Percent points; of the variance squared.
        seeds: of `values`; () where all terms are fixed or not paired.
        error: standard error, over the draw of the images, of the mean of `values`; NaN with too
            few blocks for it.
        blocks: number of blocks of images that hold images of the metric.
        said: what was drawn, e.g. "40 blocks of up to 10 neighbouring frames".
        reason: why so, see `analysis.uncertainty.blocks.ImageBlocks.reason`.
        drawn: (resamples,) contrasts with blocks drawn anew; () with too few.
        trainings: error over seeds; None for a single seed.
    """

    values: tuple[float, ...]
    seeds: tuple[int, ...]
    error: float
    blocks: int
    said: str
    reason: str = ""
    drawn: Values = field(default_factory=lambda: np.empty(0), repr=False, compare=False)
    trainings: Spread | None = None

    @property
    def images(self) -> Spread | None:
        """Error over the draw of the images; None with too few blocks or nothing to score."""
        return None if math.isnan(self.error) else Spread(self.error, self.blocks - 1)


def combine(weights: Sequence[float], parts: Sequence[Evidence]) -> Evidence:
    """The evidence about a weighted sum of contrasts with the same seeds and draws of images.

    Raises:
        ValueError: other seeds or blocks.
    """
    first = parts[0]
    if any((each.seeds, each.blocks) != (first.seeds, first.blocks) for each in parts):
        raise ValueError("combine: expected the same seeds and images in all parts.")
    values = np.array(weights) @ np.array([each.values for each in parts])
    drawn = np.array(weights) @ np.array([each.drawn for each in parts])
    spread = over_images(drawn, first.blocks)
    return replace(
        first,
        values=tuple(values.tolist()),
        error=math.nan if spread is None else spread.error,
        drawn=drawn,
        trainings=over_seeds(values),
    )


class Resampler:
    """Evidence about contrasts; scores of a run are resampled once.

    Images are drawn in the order of their names, so that the draws depend on no term. With
    ``blocks=auto`` the length of the blocks is that of each contrast (see
    `analysis.uncertainty.blocks.make_blocks`).

    Args:
        settings: of the resampling; `level` has no effect here.
        alike: what the counts must have in common beside images and classes.
    """

    def __init__(self, settings: Resampling, alike: Alike = "labels") -> None:
        self._settings = settings
        self._alike = alike
        self._scores = RunScores(settings)
        self._ordered: dict[tuple[str, str], Counts] = {}

    def evidence(self, terms: Sequence[Term], *, paired: bool = True) -> Evidence:
        """As `contrast`; InputError where a run has nothing to score."""
        found = self.contrast(terms, paired=paired)
        if np.isnan(found.values).any():
            keys = ", ".join(dict.fromkeys(key for term in terms for key in term.keys.values()))
            raise InputError(
                f"'{terms[0].metric}' of one of {keys} has nothing to score: no pixel is labelled "
                "or predicted so. Use absent=released, or omit the column."
            )
        return found

    def contrast(self, terms: Sequence[Term], *, paired: bool = True) -> Evidence:
        """What the data say about the sum of `terms`, each times its weight; NaN: nothing to score.

        Fixed terms are paired with every seed of the others. For a mean of contrasts, pass the
        terms of all of them with their weights divided by the number of contrasts.

        Args:
            terms: one or more.
            paired: whether equal seeds are one training, or share their initial weights and the
                order of their data. If not, the spreads of the terms add up (Welch).

        Raises:
            InputError: other images, classes or labels; no common seed; blocks that cannot be made.
            ValueError: no terms.
        """
        if not terms:
            raise ValueError("contrast: expected one term or more.")
        seeds = _common_seeds(terms) if paired else ()
        chosen = [
            list(seeds) if seeds and not term.fixed else sorted(term.counts) for term in terms
        ]
        absent = self._settings.absent or convention(
            counts for term in terms for counts in term.counts.values()
        )
        runs = self._runs(terms, chosen)
        first = next(iter(runs[0].values()))
        blocks = make_blocks(first.names, self._settings.blocks, self._series(terms, runs, absent))
        used = min(map(self._blocks_used, terms, runs, [blocks] * len(runs)))
        parts, drawn = [], np.zeros(self._settings.resamples if used >= FEWEST else 0)
        for term, at, each in zip(terms, chosen, runs, strict=True):
            points = self._scores.points(term.metric, each, absent)
            parts.append(term.weight * np.array([points[term.keys[seed]] for seed in at]))
            if len(drawn):
                scores = self._scores.drawn(term.metric, each, blocks, absent)
                drawn += term.weight * np.mean([scores[term.keys[seed]] for seed in at], axis=0)
        values = np.sum(
            np.broadcast_arrays(*parts) if paired else [p.mean() for p in parts], axis=0
        )
        of_images = over_images(drawn, used)
        return Evidence(
            values=tuple(np.atleast_1d(values).tolist()),
            seeds=seeds,
            error=math.nan if of_images is None else of_images.error,
            blocks=used,
            said=blocks.said if used == blocks.count else f"{used} of {blocks.said}",
            reason=blocks.reason,
            drawn=drawn,
            trainings=over_seeds(values) if paired else over_seeds(*parts),
        )

    def _runs(
        self, terms: Sequence[Term], chosen: Sequence[Sequence[int]]
    ) -> list[dict[str, Counts]]:
        """Per term the counts of the chosen seeds by key, images in the order of their names."""
        start, at = terms[0], chosen[0][0]
        reference, name = start.counts[at], start.keys[at]
        runs: list[dict[str, Counts]] = []
        for term, seeds in zip(terms, chosen, strict=True):
            for key, counts in ((term.keys[seed], term.counts[seed]) for seed in seeds):
                if (name, key) not in self._ordered:
                    same = in_order(reference, counts, self._alike)
                    self._ordered[name, key] = same.select(sorted(same.names))
            runs.append({term.keys[seed]: self._ordered[name, term.keys[seed]] for seed in seeds})
        return runs

    @staticmethod
    def _blocks_used(term: Term, runs: Mapping[str, Counts], blocks: ImageBlocks) -> int:
        """Number of blocks with images of the metric."""
        counts = next(iter(runs.values()))
        kept = images_of(parse(term.metric), counts).names
        return len(np.unique(blocks.index[np.isin(counts.names, kept)]))

    def _series(
        self, terms: Sequence[Term], runs: Sequence[Mapping[str, Counts]], absent: Absent
    ) -> Values:
        """(L, N) influence of every image on each term and on the contrast, for "auto" blocks."""
        if self._settings.blocks != "auto":
            return np.empty((0, 0))
        every = [self._scores.influence(each, absent) for each in runs]
        kinds = {watched(counts) for each in runs for counts in each.values()}
        if len(terms) > 1 and len(kinds) == 1:
            weighted = [term.weight * each for term, each in zip(terms, every, strict=True)]
            every.append(np.sum(weighted, axis=0))
        return np.asarray(np.nan_to_num(np.concatenate(every)), np.float64)


def _common_seeds(terms: Sequence[Term]) -> tuple[int, ...]:
    """Seeds that all terms with seeds have, ascending; () where all terms are fixed."""
    trained = [set(term.counts) for term in terms if not term.fixed]
    if not trained:
        return ()
    shared = set.intersection(*trained)
    if not shared:
        lists = [", ".join(map(str, sorted(seeds))) for seeds in trained]
        raise InputError(
            f"the compared rows have no seed in common: {' and '.join(dict.fromkeys(lists))}. "
            "Train the same seeds of each row."
        )
    return tuple(sorted(shared))
