"""Counts of one or two methods on the same images, made ready for many resamples."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from analysis.uncertainty.blocks import FEWEST, ImageBlocks, make_blocks
from analysis.uncertainty.same_images import aligned, aligned_images
from analysis.uncertainty.settings import Resampling
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts, convention
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import ParsedMetric, images_of, parse, values
from rgbt.metrics.pairs import HEADLINES, protocol_of
from rgbt.metrics.score_grid import headlines
from rgbt.randomness import numpy_generator

CHUNK = 500
"""Resamples computed at once, which limits the memory that their counts take."""

Scores = NDArray[np.float64]


@dataclass(frozen=True)
class ResampledScores:
    """Scores of one method, percent; NaN: nothing to score.

    Attributes:
        points: (metrics, S) of every seed over all images.
        resampled: (metrics, resamples) mean over seeds; none with too few blocks.
        without: (metrics, B) the same without one block each.
    """

    points: Scores
    resampled: Scores
    without: Scores

    def rows(self) -> Iterator[tuple[Scores, Scores, Scores]]:
        """Points, resampled and without of each metric."""
        return zip(self.points, self.resampled, self.without, strict=True)


@dataclass(frozen=True)
class CommonImages:
    """Counts of M methods, each with its seeds, on the same images.

    Attributes:
        methods: per method (S, B, R M K) float64: counts of every seed, summed inside each block;
            whole numbers below 2^53, so that sums are exact.
        shape: (R, M, K) of the counts of one image; of single frames M = K.
        like: counts of the same classes, scored ones and partition.
        images: N.
        absent: how a class without pixels scores.
    """

    methods: tuple[NDArray[np.float64], ...]
    shape: tuple[int, int, int]
    like: Counts
    images: int
    blocks: ImageBlocks
    settings: Resampling
    absent: Absent

    def in_blocks(self, blocks: ImageBlocks) -> CommonImages:
        """The same images, summed inside `blocks`; so far each image is a block."""
        order = np.argsort(blocks.index, kind="stable")
        starts = np.searchsorted(blocks.index[order], np.arange(blocks.count))
        summed = (np.add.reduceat(each[:, order], starts, axis=1) for each in self.methods)
        return replace(self, methods=tuple(summed), blocks=blocks)

    def drawn(self, parsed: Sequence[ParsedMetric]) -> list[ResampledScores]:
        """The scores of every method, as they are and with images drawn anew or left out."""
        if self.blocks.count < FEWEST:
            nothing = np.empty((len(parsed), 0))
            return [ResampledScores(points, nothing, nothing) for points in self.points(parsed)]
        parts = (self.points(parsed), self.resampled(parsed), self.without_each(parsed))
        return [ResampledScores(*each) for each in zip(*parts, strict=True)]

    def points(self, parsed: Sequence[ParsedMetric]) -> list[Scores]:
        """Per method (metrics, S): the score of every seed over all images."""
        return [self._scores(parsed, method.sum(1)) for method in self.methods]

    def resampled(self, parsed: Sequence[ParsedMetric]) -> list[Scores]:
        """Per method (metrics, resamples): mean over seeds; both methods see the same draws."""
        count = self.blocks.count
        even = np.full(count, 1.0 / count)
        found = [np.empty((len(parsed), self.settings.resamples)) for _ in self.methods]
        rng = numpy_generator(self.settings.seed, "bootstrap")
        for chunk in _chunks(self.settings.resamples):
            weights = rng.multinomial(count, even, chunk.stop - chunk.start).astype(np.float64)
            for scores, method in zip(found, self.methods, strict=True):
                scores[:, chunk] = self._scores(parsed, weights @ method).mean(1)
        return found

    def swapped(self, parsed: Sequence[ParsedMetric]) -> list[Scores]:
        """Two methods (metrics, resamples) whose predictions were exchanged on half of the blocks.

        Seeds are exchanged in pairs; where the numbers of seeds differ, each is repeated as often
        as makes them equal.
        """
        first, second = self.methods
        pairs = math.lcm(len(first), len(second))
        found = [np.zeros((len(parsed), self.settings.resamples)) for _ in self.methods]
        # Pair by pair, with the same draws for each: all at once would not fit into memory.
        for a, b in (
            (first[pair % len(first)], second[pair % len(second)]) for pair in range(pairs)
        ):
            moved, sums = b - a, (a.sum(0), b.sum(0))
            rng = numpy_generator(self.settings.seed, "swap")
            for chunk in _chunks(self.settings.resamples):
                size = chunk.stop - chunk.start
                swapped = rng.integers(0, 2, (size, self.blocks.count)).astype(np.float64) @ moved
                found[0][:, chunk] += self._scores(parsed, sums[0] + swapped) / pairs
                found[1][:, chunk] += self._scores(parsed, sums[1] - swapped) / pairs
        return found

    def without_each(self, parsed: Sequence[ParsedMetric]) -> list[Scores]:
        """Per method (metrics, B): the mean over seeds without one block each (jackknife)."""
        return [
            self._scores(parsed, method.sum(1, keepdims=True) - method).mean(1)
            for method in self.methods
        ]

    def _scores(self, parsed: Sequence[ParsedMetric], summed: NDArray[np.float64]) -> Scores:
        """(metrics, ...) percent of summed counts (..., R K K)."""
        by_region = summed.reshape(*summed.shape[:-1], *self.shape)
        given = (by_region, self.like, self.absent)
        return np.stack([values(each, *given) for each in parsed])


def prepare(
    methods: Sequence[Sequence[Counts]],
    metric: ParsedMetric,
    settings: Resampling,
    *,
    same_pixels: bool = True,
) -> CommonImages:
    """Counts of the images that `metric` is over, summed inside blocks.

    Args:
        methods: per method the counts of its seeds; all of the same images, in any order.
        metric: over the images of the day, of the night, or all.
        settings: of the resampling.
        same_pixels: whether all must count the same pixels, by the same partition.

    Raises:
        InputError: counts of other images, classes, scored classes, regions or data; no images of
            that part; blocks that cannot be made.
    """
    like = methods[0][0]
    join = aligned if same_pixels else aligned_images
    alike = [[join(like, counts) for counts in seeds] for seeds in methods]
    parts = [[images_of(metric, counts) for counts in seeds] for seeds in alike]
    first = parts[0][0]
    regions, rows, classes = first.counts.shape[1:]
    flat = [
        np.stack([counts.counts.reshape(len(first.names), -1) for counts in seeds])
        for seeds in parts
    ]
    single = CommonImages(
        methods=tuple(each.astype(np.float64) for each in flat),
        shape=(regions, rows, classes),
        like=first,
        images=len(first.names),
        blocks=ImageBlocks(np.arange(len(first.names)), len(first.names), ""),
        settings=settings,
        absent=settings.absent or convention(counts for seeds in alike for counts in seeds),
    )
    try:
        blocks = make_blocks(first.names, settings.blocks, _influence(single))
    except InputError as error:
        raise InputError(f"{metric.part}: {error}" if metric.part else str(error)) from None
    return single.in_blocks(blocks)


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


def _influence(single: CommonImages) -> Scores:
    """(L, N) how much each image moves the scores of every method, and their difference."""
    if single.settings.blocks != "auto":
        return np.empty((0, single.images))
    moved = influence(single)
    series = [*moved, *([moved[1] - moved[0]] if len(moved) > 1 else [])]
    return np.asarray(np.nan_to_num(np.concatenate(series)), np.float64)


def influence(single: CommonImages) -> list[Scores]:
    """Per method (L, N): the watched scores without each image; NaN: nothing to score."""
    return single.without_each(watched(single.like))


def _chunks(total: int) -> Iterator[slice]:
    for start in range(0, total, CHUNK):
        yield slice(start, min(start + CHUNK, total))
