"""Intervals for quantities of a split: resampled blocks of images, by day and by night.

Neighbouring frames of a drive show nearly the same scene, so that blocks of them are drawn, not
images. Small and local: comparing methods is the business of `analysis.uncertainty`.
"""

from __future__ import annotations

import math
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.derive import snr_of
from rgbt.metrics.names import DAY, NIGHT
from rgbt.randomness import numpy_generator

MOST_RESAMPLES = 100_000
"""How often each resample draws each block is held in memory at once: 8 bytes each."""

MIN_BLOCKS = 5
"""Fewer blocks of a part say too little about how blocks differ to decide anything."""

Scale = Literal["linear", "ratio"]
Floats = NDArray[np.float64]


class ValueInterval(NamedTuple):
    """A value with the ends of its interval; NaN ends where there is none."""

    value: float
    low: float
    high: float


class ConsecutiveBlocks:
    """Blocks of images and how often each resample draws each of them.

    The images of a part (day, night; all where the data set does not tell) are sorted by name and
    cut into blocks of `size` consecutive ones; every resample draws as many blocks of the part as
    it has, with replacement. Row 0 of everything is the sample itself, the other rows resamples.

    This is not the rule of `analysis.uncertainty.blocks`. Here blocks have one fixed length, follow
    the names across sequences, never hold both day and night, and every resample keeps the number
    of blocks of each part; the last block of a part is what is left over. There blocks are pieces
    of nearly equal length of one sequence (names alike but for the number of the frame), day and
    night are not held apart within a sequence, and the length is measured from how alike
    neighbours score unless a number is given. Measurements of images have no score to measure it
    by, and day must be compared with night; but the two rules may give intervals of other widths.

    Args:
        stats: measurements.
        size: images per block, at least 1, which treats images as independent.
        resamples: B, 2 to `MOST_RESAMPLES`.
        seed: of the draws.
    """

    def __init__(
        self, stats: SpatialStatistics, *, size: int = 10, resamples: int = 2000, seed: int = 0
    ) -> None:
        every = np.arange(len(stats.names))
        strata = {ALL: every}
        if stats.night is not None:
            strata = {DAY: every[~stats.night], NIGHT: every[stats.night]}
        self._block_of = np.zeros(len(stats.names), np.intp)
        self._stratum_of: list[str] = []
        rng = numpy_generator(seed, "statistics")
        weights = []
        for stratum, chosen in strata.items():
            ordered = chosen[np.argsort(np.array(stats.names)[chosen], kind="stable")]
            count = -(-len(ordered) // size)
            self._block_of[ordered] = len(self._stratum_of) + np.arange(len(ordered)) // size
            self._stratum_of += [stratum] * count
            drawn = rng.multinomial(count, np.full(count, 1 / max(1, count)), resamples)
            weights.append(np.vstack([np.ones((1, count)), drawn]))
        self._weights = np.hstack(weights)
        self._images_of = np.bincount(self._block_of, minlength=len(self._stratum_of))

    def mean(self, values: NDArray[np.number], part: str = ALL) -> Floats:
        """Mean over the images of `part`, of the sample and of every resample.

        Args:
            values: (N, ...).
            part: "all", "day" or "night"; one that holds images.

        Returns:
            (1 + B, ...).
        """
        summed = np.zeros((len(self._stratum_of), *values.shape[1:]))
        np.add.at(summed, self._block_of, values)
        chosen = self._chosen(part)
        weights = self._weights[:, chosen]
        totals = np.tensordot(weights, summed[chosen], axes=1)
        images = weights @ self._images_of[chosen]
        return np.asarray(totals / images.reshape(-1, *[1] * (values.ndim - 1)))

    def sizes(self, part: str = ALL) -> tuple[int, ...]:
        """Number of blocks of every stratum of `part`."""
        strata = [self._stratum_of[index] for index in self._chosen(part)]
        return tuple(strata.count(name) for name in sorted(set(strata)))

    def containing(self, present: NDArray[np.bool_]) -> int:
        """Number of blocks that hold one of the images `present`, (N,)."""
        return len(set(self._block_of[present].tolist()))

    def interval(
        self,
        samples: Floats,
        part: str = ALL,
        *,
        level: float = 0.95,
        scale: Scale = "linear",
    ) -> ValueInterval:
        """Interval of a quantity: value -+ t times its bootstrap standard error.

        With the few blocks that a small split has, percentiles of resamples are too narrow. So the
        standard error is enlarged by ``sqrt(n / (n - 1))``, n blocks of the smallest stratum, and
        t has as many degrees of freedom as there are blocks less strata; for a plain mean of one
        stratum this is the t interval of its blocks. Ratios are treated on the logarithmic scale.

        Args:
            samples: (1 + B,) of `part` as `mean` gives them, or computed from these row by row.
            part: see `mean`.
            level: of confidence, 0..1.
            scale: "ratio" for positive quotients.

        Returns:
            ends are NaN where a value is not finite or a stratum has one block.
        """
        from scipy.special import stdtrit

        value = float(samples[0])
        sizes = self.sizes(part)
        smallest, freedom = min(sizes), sum(sizes) - len(sizes)
        with np.errstate(invalid="ignore", divide="ignore"):
            scaled = np.log(samples) if scale == "ratio" else samples
        # A resample without a pixel of a rare class has no value for it.
        spread = scaled[1:][~np.isnan(scaled[1:])]
        if smallest < 2 or not np.isfinite(scaled[0]) or not np.isfinite(spread).all():
            return ValueInterval(value, math.nan, math.nan)
        quantile = float(stdtrit(freedom, 0.5 + level / 2))
        reach = quantile * float(spread.std()) * math.sqrt(smallest / (smallest - 1))
        ends = scaled[0] - reach, scaled[0] + reach
        low, high = (math.exp(end) for end in ends) if scale == "ratio" else ends
        return ValueInterval(value, float(low), float(high))

    def _chosen(self, part: str) -> list[int]:
        """Blocks of `part`."""
        return [i for i, stratum in enumerate(self._stratum_of) if part in (ALL, stratum)]


def snr_samples(
    stats: SpatialStatistics, blocks: ConsecutiveBlocks, part: str, estimator: str, average: str
) -> Floats:
    """Signal to noise of the sample and of every resample, (1 + B, 2, R); see `region_snr`."""
    mean, noise = stats.mean, stats.noise[estimator]
    if average == "pooled":
        return snr_of(blocks.mean(mean, part), blocks.mean(noise, part))
    return blocks.mean(snr_of(mean, noise), part)
