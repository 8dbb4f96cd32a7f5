"""Derived from the measurements: occupancy, Laplacian variance, signal to noise, entropy.

Pure functions of `SpatialStatistics`, by part ("all", "day", "night") and modality ("rgb" as grey,
"thermal"); unknown words are refused (InputError). The functions on arrays take any leading axes,
so that resamples go through the same lines (`claims`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from analysis.statistics.data import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.measure import ESTIMATORS
from rgbt.checks import InputError, check_choice

EPSILON = 1e-6
"""Eq. 4's "very small number", in grey levels."""

AVERAGES = ("pooled", "images")
"""How ratios of many images become one; the first is the default.

pooled: mean signal of all images over mean noise of all images. The default: a region that is flat
    in one image, with noise near 0, cannot decide the result.
images: mean over images of each image's own ratio.
"""

Floats = NDArray[np.float64]


def occupancy_map(stats: SpatialStatistics, part: str = ALL) -> Floats:
    """Share of images with a class that is no background at every pixel (SpatialSeg, Eq. 1).

    An ignored pixel is no background: a pixel's share is among the images that have a valid label
    there. The paper divides by all masks, which is the same where nothing is ignored.

    Returns:
        (H, W), 0..1; NaN where no image has a valid label.

    Raises:
        InputError: the data set has no background (`check_background`).
    """
    check_background(stats)
    occupied = stats.select(part).occupied.sum(0)
    return _ratio(occupied[~stats.is_background].sum(0), occupied.sum(0))


def region_occupancy(stats: SpatialStatistics, part: str = ALL) -> Floats:
    """Sample occupancy rate of every region (SpatialSeg, Eq. 2).

    Foreground pixels over valid pixels of all images; the mean of `occupancy_map` over the region
    where nothing is ignored.

    Returns:
        (R,), 0..1; NaN where a region has no valid pixel.

    Raises:
        InputError: the data set has no background (`check_background`).
    """
    check_background(stats)
    return occupancy_of(stats.labels[stats.chosen(part)].sum(0), stats.is_background)


def class_region_occupancy(stats: SpatialStatistics, part: str = ALL) -> Floats:
    """Share of every class among the valid pixels of every region: (K, R), 0..1."""
    return class_occupancy_of(stats.labels[stats.chosen(part)].sum(0))


def normalised(occupancy: Floats) -> Floats:
    """Each class relative to the region where it is most frequent (SpatialSeg, Fig. 3).

    Returns:
        (..., K, R) from such occupancies, 0..1, with a 1 in every row; NaN for a class that does
        not occur.
    """
    return _ratio(occupancy, occupancy.max(-1, keepdims=True))


def region_laplacian(stats: SpatialStatistics, modality: str, part: str = ALL) -> Floats:
    """Laplacian variance of every region (SpatialSeg, Eq. 3), mean over images.

    Returns:
        (R,), squared grey levels.
    """
    return np.asarray(stats.laplacian[stats.chosen(part), _modality(modality)].mean(0))


def region_noise(
    stats: SpatialStatistics, modality: str, part: str = ALL, estimator: str = ESTIMATORS[0]
) -> Floats:
    """Standard deviation of the noise of every region, mean over images: (R,), grey levels."""
    check_choice("estimator", estimator, stats.noise)
    return np.asarray(stats.noise[estimator][stats.chosen(part), _modality(modality)].mean(0))


def region_snr(
    stats: SpatialStatistics,
    modality: str,
    part: str = ALL,
    estimator: str = ESTIMATORS[0],
    average: str = AVERAGES[0],
) -> Floats:
    """Signal-to-noise ratio of every region: mean value over noise (SpatialSeg, Eq. 4).

    Args:
        stats: measurements.
        modality: "rgb" (grey) or "thermal".
        part: "all", "day" or "night".
        estimator: of the noise, one of `analysis.statistics.measure.ESTIMATORS`.
        average: one of `AVERAGES`.

    Returns:
        (R,), at least 0.

    Raises:
        InputError: unknown modality, part, estimator or average.
    """
    check_choice("estimator", estimator, stats.noise)
    check_choice("average", average, AVERAGES)
    chosen, modality_index = stats.chosen(part), _modality(modality)
    mean = stats.mean[chosen, modality_index]
    noise = stats.noise[estimator][chosen, modality_index]
    if average == "pooled":
        return snr_of(mean.mean(0), noise.mean(0))
    return np.asarray(snr_of(mean, noise).mean(0))


def label_entropy(stats: SpatialStatistics, part: str = ALL, background: bool = True) -> Floats:
    """Shannon entropy of the classes of every region's pixels, all images together, in bits.

    Source: SpatialSeg, Eq. 5 and Sec. III-C.1, applied to the label inside a region.

    Without the background classes the shares are those among the other classes.

    Returns:
        (R,), 0..log2 K; NaN where a region has no pixel to count.
    """
    labels = stats.labels[stats.chosen(part)].sum(0)
    return entropy_of(labels if background else labels[..., ~stats.is_background])


def entropies(stats: SpatialStatistics) -> tuple[tuple[str, bool], ...]:
    """The label entropies of a data set: a word for each, and whether the background counts."""
    if not stats.background:
        return (("", True),)
    return (("with background", True), ("without background", False))


def no_background(stats: SpatialStatistics) -> str:
    """Why a data set without a background class has no sample occupancy, in one sentence."""
    return (
        f"Sample occupancy is not available: no class of {stats.dataset} is stated as background. "
        "If one is, set dataset.background=[...] and measure again."
    )


def check_background(stats: SpatialStatistics) -> None:
    """Refuse statistics of a data set without a background class (InputError)."""
    if not stats.background:
        raise InputError(no_background(stats))


def occupancy_of(labels: NDArray[np.number], is_background: NDArray[np.bool_]) -> Floats:
    """(..., R, K) pixels -> (..., R) share that is of no background class, marked in (K,)."""
    return _ratio(labels[..., ~is_background].sum(-1), labels.sum(-1))


def class_occupancy_of(labels: NDArray[np.number]) -> Floats:
    """(..., R, K) pixels -> (..., K, R) share of each class."""
    return np.swapaxes(_ratio(labels, labels.sum(-1, keepdims=True)), -1, -2)


def entropy_of(labels: NDArray[np.number]) -> Floats:
    """(..., R, K) pixels -> (..., R) entropy in bits; NaN without a pixel."""
    share = _ratio(labels, labels.sum(-1, keepdims=True))
    # 0 log 0 = 0; a share that does not exist stays NaN.
    logarithm = np.log2(np.where(share == 0, 1.0, share))
    return np.asarray(np.abs((share * logarithm).sum(-1)))


def snr_of(mean: Floats, noise: Floats) -> Floats:
    """Eq. 4, element by element."""
    return np.asarray(mean / (noise + EPSILON))


def _modality(modality: str) -> int:
    check_choice("modality", modality, MODALITIES)
    return MODALITIES.index(modality)


def _ratio(above: NDArray[np.number], below: NDArray[np.number]) -> Floats:
    """Quotient that is NaN, without a warning, where nothing was counted."""
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(above / below, np.float64)
