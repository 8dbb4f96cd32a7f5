"""Linear contrasts of scores: values paired by seed, and their error over the draw of the images.

The bootstrap of Agarwal et al. (NeurIPS 2021, rliable) draws the runs of each task anew. It treats
tasks as fixed. Here the runs (seeds) are few and their scores are paired, so that the spread over
seeds is Student's or that of a confidence sequence, and only the images are drawn anew. Every run
sees the same draws of blocks of images, so that what an image does to all rows cancels.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.blocks import FEWEST, ImageBlocks, make_blocks
from analysis.uncertainty.estimate import block_spread
from analysis.uncertainty.images import watched
from analysis.uncertainty.run_scores import RunScores
from analysis.uncertainty.same_images import aligned_images
from analysis.uncertainty.settings import Resampling
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
        values: contrast of each seed that all terms with seeds have; of fixed terms alone one
            value. Percent points; of the variance squared percent points.
        seeds: of `values`; () where all terms are fixed.
        error: standard error, over the draw of the images, of the mean of `values`; NaN with too
            few blocks for it.
        blocks: number of blocks of images that hold images of the metric.
        said: what was drawn, e.g. "40 blocks of up to 10 neighbouring frames".
    """

    values: tuple[float, ...]
    seeds: tuple[int, ...]
    error: float
    blocks: int
    said: str


class Resampler:
    """Evidence about the contrasts of one table.

    Images are drawn in the order of their names, so that the draws depend on no term. With
    ``blocks=auto`` the length of the blocks is that of each contrast (see
    `analysis.uncertainty.blocks.make_blocks`); contrasts with the same blocks share draws and
    cached scores.

    Args:
        settings: of the resampling; `level` and `method` have no effect here.
    """

    def __init__(self, settings: Resampling) -> None:
        self._settings = settings
        self._scores = RunScores(settings)
        self._checked: set[tuple[str, str]] = set()

    def evidence(self, terms: Sequence[Term]) -> Evidence:
        """What the data say about the sum of `terms`, each times its weight.

        Fixed terms are paired with every seed of the others. For a mean of contrasts, pass the
        terms of all of them with their weights divided by the number of contrasts.

        Raises:
            InputError: other images, classes or labels; no common seed; nothing to score; blocks
                that cannot be made.
            ValueError: no terms.
        """
        if not terms:
            raise ValueError("evidence: expected one term or more.")
        seeds = _common_seeds(terms)
        absent = self._settings.absent or convention(
            counts for term in terms for counts in term.counts.values()
        )
        chosen = [[FIXED] if term.fixed else list(seeds) for term in terms]
        runs = self._runs(terms, chosen)
        values = self._values(terms, chosen, runs, absent)
        first = next(iter(runs[0].values()))
        series = self._series(terms, runs, absent)
        blocks = make_blocks(first.names, self._settings.blocks, series)
        used = min(
            _blocks_used(term.metric, next(iter(each.values())), blocks)
            for term, each in zip(terms, runs, strict=True)
        )
        error = math.nan
        if used >= FEWEST:
            drawn = np.zeros(self._settings.resamples)
            for term, at, each in zip(terms, chosen, runs, strict=True):
                scores = self._scores.resampled(term.metric, each, blocks, absent)
                drawn += term.weight * np.mean([scores[term.keys[seed]] for seed in at], axis=0)
            error = block_spread(drawn, used).error
        return Evidence(
            values=tuple(values.tolist()), seeds=seeds, error=error, blocks=used, said=blocks.said
        )

    def _runs(
        self, terms: Sequence[Term], chosen: Sequence[Sequence[int]]
    ) -> list[dict[str, Counts]]:
        """Per term the counts of the chosen seeds by key, images in the order of their names."""
        start, at = terms[0], chosen[0][0]
        reference, name = start.counts[at], start.keys[at]
        order = tuple(sorted(reference.names))
        runs: list[dict[str, Counts]] = []
        for term, seeds in zip(terms, chosen, strict=True):
            by_key = {}
            for seed in seeds:
                counts, key = term.counts[seed], term.keys[seed]
                if (name, key) not in self._checked:
                    aligned_images(reference, counts)
                    self._checked.add((name, key))
                by_key[key] = counts if counts.names == order else counts.select(order)
            runs.append(by_key)
        return runs

    def _values(
        self,
        terms: Sequence[Term],
        chosen: Sequence[Sequence[int]],
        runs: Sequence[Mapping[str, Counts]],
        absent: Absent,
    ) -> NDArray[np.float64]:
        """(S,) contrast of each seed."""
        total = np.zeros(max(map(len, chosen)))
        for term, seeds, each in zip(terms, chosen, runs, strict=True):
            scores = self._scores.points(term.metric, each, absent)
            points = np.array([scores[term.keys[seed]] for seed in seeds])
            if np.isnan(points).any():
                where = term.keys[seeds[int(np.isnan(points).argmax())]]
                raise InputError(
                    f"'{term.metric}' of {where} has nothing to score: no pixel is labelled or "
                    "predicted so. Use absent=released, or omit the column."
                )
            total += term.weight * points
        return total

    def _series(
        self, terms: Sequence[Term], runs: Sequence[Mapping[str, Counts]], absent: Absent
    ) -> NDArray[np.float64]:
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


def _blocks_used(metric: str, like: Counts, blocks: ImageBlocks) -> int:
    """Number of blocks with images of the metric."""
    kept = images_of(parse(metric), like).names
    return len(np.unique(blocks.index[np.isin(like.names, kept)]))
