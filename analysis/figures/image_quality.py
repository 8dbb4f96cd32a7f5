"""SpatialSeg, Figs. 5 and 6: Laplacian variance and signal-to-noise ratio by region."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput
from analysis.statistics.data import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.derive import AVERAGES, region_laplacian, region_snr
from analysis.statistics.measure import ESTIMATORS
from analysis.statistics.resampling import ConsecutiveBlocks, snr_samples
from rgbt.checks import check_choice

Floats = NDArray[np.float64]
Key = tuple[str, str]
"""Modality and part of a series."""

NAMES = {"rgb": "RGB", "thermal": "thermal"}
MARKS = {"all": ("o", "-"), "day": ("s", "--"), "night": ("^", ":")}
"""Marker and line of each part; the modality is the colour."""

LEVEL = 0.95
SPREAD = 0.5
"""Regions over which the series are drawn side by side, so that their bars do not overlap."""

FAR_APART = 5.0
"""A logarithmic axis where one modality's median is more than this many times the other's."""


@dataclass(frozen=True)
class RegionSeries:
    """A measure of the images by region.

    Attributes:
        measure: as the axis says it.
        values: series -> (R,).
        bands: series -> (2, R), ends of the 95 % interval over blocks of neighbouring images; NaN
            where there are too few.
        images: part -> number of images.
    """

    measure: str
    partition: str
    values: Mapping[Key, Floats]
    bands: Mapping[Key, Floats]
    images: Mapping[str, int]
    is_log: bool


def make_laplacian(given: FigureInput) -> Figure:
    """Laplacian variance by region."""
    statistics = given.statistics(by_region=True)
    return draw(laplacian_series(statistics, ConsecutiveBlocks(statistics)))


def make_snr(given: FigureInput) -> Figure:
    """Signal-to-noise ratio by region."""
    way = given.get("estimator", ESTIMATORS[0]), given.get("average", AVERAGES[0])
    statistics = given.statistics(by_region=True)
    return draw(snr_series(statistics, ConsecutiveBlocks(statistics), *way))


def laplacian_series(statistics: SpatialStatistics, blocks: ConsecutiveBlocks) -> RegionSeries:
    """Laplacian variance by region (SpatialSeg, Eq. 3 and Fig. 5), mean over images.

    The paper cuts images into nine rings; `blocks` are resamples of them, for the bands.
    """
    return _series(
        "Laplacian variance\n(squared grey levels)",
        (statistics, blocks),
        lambda modality, part: region_laplacian(statistics, modality, part),
        lambda part: blocks.mean(statistics.laplacian, part),
    )


def snr_series(
    statistics: SpatialStatistics, blocks: ConsecutiveBlocks, estimator: str, average: str
) -> RegionSeries:
    """Signal-to-noise ratio by region (SpatialSeg, Eq. 4 and Fig. 6).

    Args:
        statistics: of a data set.
        blocks: resamples of its images, for the bands.
        estimator: of the noise, which the paper leaves open; a key of ``statistics.noise``.
        average: one of `analysis.statistics.derive.AVERAGES`.

    Raises:
        InputError: an unknown estimator or average.
    """
    check_choice("estimator", estimator, statistics.noise)
    way = estimator, average
    return _series(
        f"signal-to-noise ratio ({estimator})",
        (statistics, blocks),
        lambda modality, part: region_snr(statistics, modality, part, *way),
        lambda part: snr_samples(statistics, blocks, part, *way),
    )


def _series(
    measure: str,
    sample: tuple[SpatialStatistics, ConsecutiveBlocks],
    value: Callable[[str, str], Floats],
    drawn: Callable[[str], Floats],
) -> RegionSeries:
    """Of `value` (R,) by modality and part, with bands from `drawn` (1 + B, 2, R) by part."""
    statistics, blocks = sample
    values, bands = {}, {}
    for part in statistics.subsets():
        resampled = drawn(part)
        for index, modality in enumerate(MODALITIES):
            values[modality, part] = value(modality, part)
            found = [
                blocks.interval(each, part, level=LEVEL, scale="ratio")
                for each in resampled[:, index].T
            ]
            bands[modality, part] = np.array([each[1:] for each in found]).T
    middles = [float(np.nanmedian(values[modality, ALL])) for modality in MODALITIES]
    return RegionSeries(
        measure=measure,
        partition=statistics.partition,
        values=values,
        bands=bands,
        images={part: int(statistics.chosen(part).sum()) for part in statistics.subsets()},
        is_log=min(middles) > 0 and max(middles) > FAR_APART * min(middles),
    )


@style.styled
def draw(data: RegionSeries) -> Figure:
    """Six lines with intervals: modality by colour, part by marker and line."""
    figure = style.new_figure(style.COLUMN, 3.1)
    axes = figure.subplots()
    order = list(product(MODALITIES, data.images))
    for index, key in enumerate(order):
        values, (low, high) = data.values[key], data.bands[key]
        shift = SPREAD * (index / max(1, len(order) - 1) - 0.5)
        # By a rounding error a value may lie outside its interval; no bar has a negative length.
        lengths = np.maximum([values - low, high - values], 0)
        modality, part = key
        colour, (marker, line) = style.COLOURS[MODALITIES.index(modality)], MARKS[part]
        how: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": line}
        how |= {"markerfacecolor": colour if part == ALL else "white", "elinewidth": 0.6}
        places = np.arange(1, len(values) + 1) + shift
        axes.errorbar(places, values, lengths, label=f"{NAMES[modality]}, {part}", **how)
    style.region_axis(axes, len(values), f"region ({data.partition})")
    if data.is_log:
        style.log_axis(axes)
    else:
        axes.set_ylim(bottom=0)
    axes.set_ylabel(data.measure)
    numbers = ", ".join(f"{part} {count}" for part, count in data.images.items())
    axes.set_title(
        f"bars: 95 % over blocks of neighbouring images\n({numbers})", fontsize=style.SMALL
    )
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(NAMES))
    return figure
