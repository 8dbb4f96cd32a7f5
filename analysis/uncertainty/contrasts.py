"""Linear contrasts of scores: values paired by seed, and their error over the draw of the images.

The bootstrap of Agarwal et al. (NeurIPS 2021, rliable) draws the runs of each task anew. It treats
tasks as fixed. Here the runs (seeds) are few and their scores are paired, so that the spread over
seeds is Student's or that of a confidence sequence, and only the images are drawn anew. Every run
sees the same draws of blocks of images, so that what an image does to all rows cancels.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from rgbt.metrics.counts import Counts

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
