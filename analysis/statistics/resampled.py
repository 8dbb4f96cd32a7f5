"""Quantities of a split by region, of the split as it is and with its images resampled."""

from __future__ import annotations

import math
from collections.abc import Iterator
from copy import copy
from itertools import product

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.statistics.collect import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.measure import ESTIMATORS
from analysis.uncertainty.blocks import Resampling, make_blocks
from analysis.uncertainty.contrasts import Evidence
from analysis.uncertainty.intervals import over_images, student
from rgbt.checks import InputError, check_choice
from rgbt.metrics.names import NIGHT

# Eq. 4's "very small number", in grey levels.
EPSILON = 1e-6

# Ways to average the ratios of many images; the first is the default.
#
# pooled: mean signal of all images over mean noise of all images. A region that is flat in one
#     image, with noise near 0, cannot decide the result.
# images: mean of the ratios of the images.
AVERAGES = ("pooled", "images")

# Least number of blocks of day or night: fewer say too little about how blocks differ.
LEAST = 5

COLUMNS = ["quantity", "modality", "class", "estimator", "average"]

# Array with 1 + B rows: the sample, then its resamples.
Values = NDArray[np.float64]


class ResampledSplit:
    """The images of a split, and B resamples of them: blocks within day and within night.

    Args:
        stats: measurements.
        settings: of the resampling; None: no resamples, B = 0.
        way: estimator of the noise, and one of `AVERAGES`, where none is named.

    Raises:
        InputError: blocks that cannot be made of these images, or an unknown estimator or average.
    """

    def __init__(
        self,
        stats: SpatialStatistics,
        settings: Resampling | None = None,
        way: tuple[str, str] = (ESTIMATORS[0], AVERAGES[0]),
    ) -> None:
        check_choice("estimator", way[0], ESTIMATORS)
        check_choice("average", way[1], AVERAGES)
        self.stats, self.settings, self.way = stats, settings, way
        night = np.zeros(len(stats.names), bool) if stats.night is None else stats.night
        # Objects, sharpness and brightness of an image tell how far neighbours are alike.
        measured = np.concatenate([stats.laplacian.mean(2), stats.mean.mean(2)], axis=1).T
        objects = stats.labels[..., ~stats.is_background].sum((1, 2))
        share = _ratio(objects, stats.labels.sum((1, 2)))
        series = np.nan_to_num(np.vstack([measured, share]))
        choice = settings.blocks if settings else "none"
        self.blocks = make_blocks(stats.names, choice, series, night)
        draws = self.blocks.draws(settings) if settings else ()
        self._weights = np.vstack([np.ones((1, self.blocks.count)), *draws])
        self._is_night = np.zeros(self.blocks.count, bool)
        self._is_night[self.blocks.index] = night

    def by(self, way: tuple[str, str]) -> ResampledSplit:
        """Return the same draws, with another estimator and average of the noise."""
        other = copy(self)
        other.way = way
        return other

    def mean(self, values: NDArray[np.number], part: str = ALL) -> Values:
        """Average (N, ...) over the images of "all", "day" or "night" to (1 + B, ...)."""
        self.stats.chosen(part)
        used = self._is_night == (part == NIGHT) if part != ALL else slice(None)
        weights = self._weights[:, used]
        images = weights @ np.bincount(self.blocks.index)[used]
        totals = np.tensordot(weights, self.blocks.summed(values)[used], axes=1)
        return np.asarray(totals / images.reshape(-1, *[1] * (values.ndim - 1)))

    def occupancy(self, part: str = ALL) -> Values:
        """Return (1 + B, R), the share of valid pixels of no background class (Eq. 2).

        Raises:
            InputError: the data set has no background class.
        """
        check_background(self.stats)
        return occupancy_of(self.mean(self.stats.labels, part), self.stats.is_background)

    def classes(self, part: str = ALL) -> Values:
        """Return (1 + B, K, R), the share of every class among the valid pixels."""
        labels = self.mean(self.stats.labels, part)
        return np.swapaxes(_ratio(labels, labels.sum(-1, keepdims=True)), -1, -2)

    def entropy(self, part: str = ALL, *, background: bool = True) -> Values:
        """Return (1 + B, R), the Shannon entropy of the classes in bits; NaN without a pixel.

        Source: SpatialSeg, Eq. 5 and Sec. III-C.1, applied to the label inside a region. Without
        the background classes the shares are those among the other classes.
        """
        kept = ~self.stats.is_background | background
        labels = self.mean(self.stats.labels, part)[..., kept]
        share = _ratio(labels, labels.sum(-1, keepdims=True))
        # 0 log 0 = 0; a share that does not exist stays NaN.
        return np.asarray(np.abs((share * np.log2(np.where(share == 0, 1.0, share))).sum(-1)))

    def laplacian(self, part: str = ALL) -> Values:
        """Return (1 + B, 2, R), the Laplacian variance (Eq. 3) in squared grey levels."""
        return self.mean(self.stats.laplacian, part)

    def noise(self, part: str = ALL, estimator: str = "") -> Values:
        """Return (1 + B, 2, R), the standard deviation of the noise in grey levels."""
        return self.mean(self.stats.noise[:, ESTIMATORS.index(estimator or self.way[0])], part)

    def snr(self, part: str = ALL, way: tuple[str, str] | None = None) -> Values:
        """Return (1 + B, 2, R), the signal-to-noise ratio: mean grey level over noise (Eq. 4)."""
        estimator, average = way or self.way
        signal, noise = self.stats.mean, self.stats.noise[:, ESTIMATORS.index(estimator)]
        if average == "pooled":
            return self.mean(signal, part) / (self.mean(noise, part) + EPSILON)
        return self.mean(signal / (noise + EPSILON), part)

    def evidence(
        self, values: Values, part: str = ALL, present: NDArray[np.bool_] | None = None
    ) -> Evidence:
        """Return what the split says about one number, (1 + B,) of `part`.

        `present`: the images (N,) that say anything about it. There is no interval with fewer than
        `LEAST` blocks of them, or of day or night. A resample without a rare class has no value.
        """
        used = self._is_night == (part == NIGHT) if part != ALL else self._is_night >= 0
        sizes = [number for number in np.bincount(self._is_night[used]).tolist() if number]
        holding = self.blocks.index if present is None else self.blocks.index[present]
        count = min(*sizes, len(np.intersect1d(holding, np.flatnonzero(used))))
        known = np.isfinite(values[0]) and not np.isinf(values[1:]).any() and count >= LEAST
        spread = over_images(values[1:], *sizes) if known else None
        return Evidence(
            values=(float(values[0]),),
            seeds=(),
            error=spread.error if spread else math.nan,
            blocks=round(spread.freedom) + 1 if spread else count,
            said=f"{count} blocks of images",
        )

    def bounded(self, values: Values, part: str = ALL) -> tuple[float, float, float]:
        """Return a positive number and its interval on the logarithmic scale; NaN: no interval."""
        with np.errstate(divide="ignore", invalid="ignore"):
            found = self.evidence(np.log(values), part)
        if found.images is None or self.settings is None:
            return float(values[0]), math.nan, math.nan
        interval = student(found.values[0], found.images, self.settings.level)
        return float(values[0]), math.exp(interval.low), math.exp(interval.high)


def occupancy_of(labels: NDArray[np.number], is_background: NDArray[np.bool_]) -> Values:
    """Return (..., R), the share of (..., R, K) pixels that is of no background class (K,)."""
    return _ratio(labels[..., ~is_background].sum(-1), labels.sum(-1))


def occupancy_map(stats: SpatialStatistics, part: str = ALL) -> Values:
    """Return (H, W), the share of images without background (SpatialSeg, Eq. 1); 0..1.

    An ignored pixel is no background: a pixel's share is among the images that have a valid label
    there, NaN where none has. The paper divides by all masks, which is the same where nothing is
    ignored. InputError: the data set has no background class.
    """
    check_background(stats)
    return occupancy_of(np.moveaxis(stats.occupied_in(part), 0, -1), stats.is_background)


def normalised(occupancy: Values) -> Values:
    """Divide each class of (..., K, R) by the region where it is most frequent (Fig. 3).

    0..1 with a 1 in every row; NaN for a class that does not occur.
    """
    return _ratio(occupancy, occupancy.max(-1, keepdims=True))


def entropies(stats: SpatialStatistics) -> tuple[tuple[str, bool], ...]:
    """Name the label entropies of a data set, and say whether the background counts."""
    if not stats.background:
        return (("label entropy", True),)
    return ("label entropy with background", True), ("label entropy without background", False)


def check_background(stats: SpatialStatistics) -> None:
    """Refuse statistics of a data set without a background class (InputError)."""
    if not stats.background:
        raise InputError(no_background(stats))


def no_background(stats: SpatialStatistics) -> str:
    """Say why a data set without a background class has no sample occupancy."""
    return (
        f"Sample occupancy is not available: no class of {stats.dataset} is stated as background. "
        "If one is, set dataset.background=[...] and measure again."
    )


def quantities(stats: SpatialStatistics) -> pd.DataFrame:
    """Compute all quantities by part of the images and region, one value a row.

    Columns: dataset, split, partition, images, part, `COLUMNS`, region (from 1), value. Shares are
    0..1, noise is in grey levels, Laplacian variance in squared grey levels, entropy in bits.
    """
    sample, rows = ResampledSplit(stats), []
    for part in stats.subsets():
        about = (stats.dataset, stats.split, stats.partition, int(stats.chosen(part).sum()), part)
        for keys, values in _of_part(sample, part):
            for region, value in enumerate(values.tolist(), 1):
                rows.append((*about, *keys, region, value))
    names = ["dataset", "split", "partition", "images", "part", *COLUMNS, "region", "value"]
    return pd.DataFrame(rows, columns=names)


def _of_part(sample: ResampledSplit, part: str) -> Iterator[tuple[tuple[str, ...], Values]]:
    stats = sample.stats
    if stats.background:
        yield ("occupancy", "", "", "", ""), sample.occupancy(part)[0]
    by_class = sample.classes(part)[0]
    for index, name in enumerate(stats.classes):
        yield ("class_occupancy", "", name, "", ""), by_class[index]
        yield ("class_occupancy_normalised", "", name, "", ""), normalised(by_class)[index]
    for word, background in entropies(stats):
        yield (word, "", "", "", ""), sample.entropy(part, background=background)[0]
    for index, modality in enumerate(MODALITIES):
        yield ("laplacian", modality, "", "", ""), sample.laplacian(part)[0, index]
        for name in ESTIMATORS:
            yield ("noise", modality, "", name, ""), sample.noise(part, name)[0, index]
        for way in product(ESTIMATORS, AVERAGES):
            yield ("snr", modality, "", *way), sample.snr(part, way)[0, index]


def _ratio(above: NDArray[np.number], below: NDArray[np.number]) -> Values:
    """Divide; NaN, without a warning, where nothing was counted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(above / below, np.float64)
