"""Scores of runs as they are and with blocks of images drawn anew, each computed once."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.blocks import ImageBlocks, Resampling
from analysis.uncertainty.intervals import Values
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import ParsedMetric, images_of, parse, values
from rgbt.metrics.pairs import HEADLINES, protocol_of
from rgbt.metrics.score_grid import headlines
from rgbt.randomness import numpy_generator

CHUNK = 500
"""Resamples computed at once, which limits the memory that their counts take."""

Runs = Mapping[str, Counts]
"""Counts by their key, all of the same images in the same order; equal keys are equal counts."""


class RunScores:
    """Scores in percent; NaN: nothing to score. Every run and metric sees the same draws."""

    def __init__(self, settings: Resampling) -> None:
        self._settings = settings
        self._points: dict[tuple[str, str, Absent], float] = {}
        self._drawn: dict[tuple[str, str, Absent, bytes], Values] = {}
        self._influence: dict[tuple[str, Absent], Values] = {}

    def points(self, metric: str, runs: Runs, absent: Absent) -> dict[str, float]:
        """Key -> score over the images of the metric."""
        for key, counts in runs.items():
            if (key, metric, absent) not in self._points:
                flat, shape, parsed = _columns(parse(metric), counts)
                score = values(parsed, flat.sum(0).reshape(shape), counts, absent)
                self._points[key, metric, absent] = float(score)
        return {key: self._points[key, metric, absent] for key in runs}

    def drawn(
        self, metric: str, runs: Runs, blocks: ImageBlocks, absent: Absent
    ) -> dict[str, Values]:
        """Key -> (resamples,) scores with `blocks` drawn anew."""
        place = metric, absent, blocks.index.tobytes()
        missing = {key: counts for key, counts in runs.items() if (key, *place) not in self._drawn}
        columns = {}
        for key, counts in missing.items():
            flat, shape, parsed = _columns(parse(metric), counts)
            columns[key] = _summed(flat, blocks), shape, parsed
            self._drawn[key, *place] = np.empty(self._settings.resamples)
        for chunk, weights in self._weights(blocks.count) if missing else ():
            for key, (flat, shape, parsed) in columns.items():
                summed = (weights @ flat).reshape(-1, *shape)
                self._drawn[key, *place][chunk] = values(parsed, summed, missing[key], absent)
        return {key: self._drawn[key, *place] for key in runs}

    def influence(self, runs: Runs, absent: Absent) -> Values:
        """(L, N) mean over `runs` of the `watched` scores without each image."""
        for key, counts in runs.items():
            if (key, absent) not in self._influence:
                flat = counts.counts.reshape(len(counts.names), -1).astype(np.float64)
                without = (flat.sum(0) - flat).reshape(counts.counts.shape)
                series = [values(each, without, counts, absent) for each in watched(counts)]
                self._influence[key, absent] = np.stack(series)
        return np.asarray(np.mean([self._influence[key, absent] for key in runs], axis=0))

    def _weights(self, blocks: int) -> Iterator[tuple[slice, Values]]:
        """How often each block is drawn, (chunk, B), by chunks of the resamples."""
        rng, total = numpy_generator(self._settings.seed, "bootstrap"), self._settings.resamples
        for start in range(0, total, CHUNK):
            stop = min(start + CHUNK, total)
            weights = rng.multinomial(blocks, np.full(blocks, 1.0 / blocks), stop - start)
            yield slice(start, stop), weights.astype(np.float64)


def watched(like: Counts) -> tuple[ParsedMetric, ...]:
    """Scores that tell how far neighbouring images are alike, whatever is requested.

    Of single frames the one that counts, and the one that shows likeness most clearly; of pairs of
    frames and of details their main scores.
    """
    if details_of(like.partition) is not None:
        return tuple(map(parse, headlines(like)))
    protocol = protocol_of(like.partition)
    single = (names.MIOU, names.PIXEL_ACCURACY)
    return tuple(map(parse, HEADLINES[protocol] if protocol else single))


def _columns(metric: ParsedMetric, counts: Counts) -> tuple[Values, tuple[int, ...], ParsedMetric]:
    """(N, F) counts that the metric reads, the shape of their sum, and the metric of that sum.

    Images of another part of the day are 0. Regions that are not read are summed or left out,
    because the draws are the slow part.
    """
    array: NDArray[np.integer] = counts.counts
    if metric.part is not None:
        used = np.isin(counts.names, images_of(metric, counts).names)
        array = array * used[:, None, None, None]
    # Rows of counts of pairs of frames and of details are not regions.
    if protocol_of(counts.partition) is None and metric.details is None:
        if metric.region is None and metric.score != names.VAR:
            array = array.sum(1, keepdims=True, dtype=np.int64)
        elif metric.region is not None and metric.region <= array.shape[1]:
            array = array[:, metric.region - 1 : metric.region]
            metric = replace(metric, region=1)
    return array.reshape(len(array), -1).astype(np.float64), array.shape[1:], metric


def _summed(flat: Values, blocks: ImageBlocks) -> Values:
    """(B, F) sums inside blocks; whole numbers below 2^53, so that they are exact."""
    order = np.argsort(blocks.index, kind="stable")
    starts = np.searchsorted(blocks.index[order], np.arange(blocks.count))
    return np.add.reduceat(flat[order], starts)
