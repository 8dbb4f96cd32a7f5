"""Scores of single runs with images drawn anew, computed once for each run, metric and blocks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.blocks import ImageBlocks
from analysis.uncertainty.images import CommonImages, influence
from analysis.uncertainty.intervals import Values
from analysis.uncertainty.settings import Resampling
from rgbt.metrics import names
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import ParsedMetric, images_of, parse
from rgbt.metrics.pairs import protocol_of

Runs = Mapping[str, Counts]
"""Counts by their key, all of the same images in the same order."""


class RunScores:
    """Cache of the scores of runs. Equal keys must be equal counts, in the same order of images."""

    def __init__(self, settings: Resampling) -> None:
        self._settings = settings
        self._points: dict[tuple[str, str, Absent], float] = {}
        self._resampled: dict[tuple[str, str, Absent, bytes], Values] = {}
        self._influence: dict[tuple[str, Absent], Values] = {}

    def points(self, metric: str, runs: Runs, absent: Absent) -> dict[str, float]:
        """Key -> score over the images of the metric, in percent; NaN: nothing to score."""
        found = {}
        for key, counts in runs.items():
            place = key, metric, absent
            if place not in self._points:
                images, parsed = self._images(parse(metric), [counts], absent)
                self._points[place] = float(images.points([parsed])[0][0, 0])
            found[key] = self._points[place]
        return found

    def resampled(
        self, metric: str, runs: Runs, blocks: ImageBlocks, absent: Absent
    ) -> dict[str, Values]:
        """Key -> (resamples,) scores; every run and metric sees the same draws of `blocks`."""
        drawn = blocks.index.tobytes()
        missing = [key for key in runs if (key, metric, absent, drawn) not in self._resampled]
        # Runs with the same regions together, so that images are drawn once for all of them.
        for partition in {runs[key].partition for key in missing}:
            keys = [key for key in missing if runs[key].partition == partition]
            images, parsed = self._images(parse(metric), [runs[key] for key in keys], absent)
            scores = images.in_blocks(blocks).resampled([parsed])
            for key, each in zip(keys, scores, strict=True):
                self._resampled[key, metric, absent, drawn] = each[0]
        return {key: self._resampled[key, metric, absent, drawn] for key in runs}

    def influence(self, runs: Runs, absent: Absent) -> Values:
        """(L, N) mean over `runs` of the watched scores without each image."""
        for key, counts in runs.items():
            if (key, absent) not in self._influence:
                flat = counts.counts.reshape(len(counts.names), -1)
                single = self._common([flat], counts, counts.counts.shape[1], absent)
                self._influence[key, absent] = influence(single)[0]
        return np.asarray(np.mean([self._influence[key, absent] for key in runs], axis=0))

    def _images(
        self, metric: ParsedMetric, every: list[Counts], absent: Absent
    ) -> tuple[CommonImages, ParsedMetric]:
        """Counts with every image of another part of the day set to 0, and the metric of them.

        The columns that the metric does not read are summed or left out before the draws, which
        are the slow part.
        """
        first = every[0]
        kept = images_of(metric, first).names
        used = np.isin(first.names, kept)[:, None, None, None]
        regions = first.counts.shape[1]
        # Rows of counts of pairs of frames and of details are not regions.
        of_regions = protocol_of(first.partition) is None and metric.details is None
        whole = of_regions and metric.region is None and metric.score != names.VAR
        one = of_regions and metric.region is not None and metric.region <= regions
        arrays: list[NDArray[np.integer]] = []
        for counts in every:
            array = counts.counts * used
            if whole:
                array = array.sum(1, keepdims=True, dtype=np.int64)
            elif one and metric.region is not None:
                array = array[:, metric.region - 1 : metric.region]
            arrays.append(array.reshape(len(first.names), -1))
        if whole or one:
            regions = 1
        read = replace(metric, region=1) if one else metric
        return self._common(arrays, first, regions, absent), read

    def _common(
        self, arrays: list[NDArray[np.integer]], like: Counts, regions: int, absent: Absent
    ) -> CommonImages:
        """Every array (N, R M K) as a method with one seed."""
        count, (rows, classes) = len(like.names), like.counts.shape[2:]
        return CommonImages(
            methods=tuple(each.astype(np.float64)[None] for each in arrays),
            shape=(regions, rows, classes),
            like=like,
            images=count,
            blocks=ImageBlocks(np.arange(count), count, ""),
            settings=self._settings,
            absent=absent,
        )
