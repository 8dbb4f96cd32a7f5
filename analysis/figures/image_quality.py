"""SpatialSeg, Figs. 5 and 6: Laplacian variance and signal-to-noise ratio by region."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import COLOURS, COLUMN, SMALL, log_axis, new_figure, region_axis, styled
from analysis.statistics.data import MODALITIES, SpatialStatistics
from analysis.statistics.derive import AVERAGES, region_laplacian, region_snr, snr_of
from analysis.statistics.resampling import ConsecutiveBlocks
from rgbt.checks import check_choice

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
Key = tuple[str, str]
"""Modality and part of a series."""

NAMES = {"rgb": "RGB", "thermal": "thermal"}
MARKS = {"all": ("o", "-"), "day": ("s", "--"), "night": ("^", ":")}
"""Marker and line of each part; the modality is the colour."""

LEVEL = 0.95
SPREAD = 0.5
"""Regions over which the series stand side by side, so that their bars can be told apart."""

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
    """

    measure: str
    partition: str
    values: Mapping[Key, Floats]
    bands: Mapping[Key, Floats]
    images: Mapping[str, int]
    is_log: bool


def laplacian_series(statistics: SpatialStatistics, blocks: ConsecutiveBlocks) -> RegionSeries:
    """Laplacian variance by region (SpatialSeg, Eq. 3 and Fig. 5), mean over images.

    Args:
        statistics: of a data set; the paper cuts it into nine rings.
        blocks: resamples of its images, for the bands.
    """
    values, bands = {}, {}
    for part in statistics.subsets():
        drawn = blocks.mean(statistics.laplacian, part)
        for index, modality in enumerate(MODALITIES):
            values[modality, part] = region_laplacian(statistics, modality, part)
            bands[modality, part] = _band(blocks, drawn[:, index], part)
    return _made("Laplacian variance\n(squared grey levels)", statistics, values, bands)


def snr_series(
    statistics: SpatialStatistics, blocks: ConsecutiveBlocks, estimator: str, average: str
) -> RegionSeries:
    """Signal-to-noise ratio by region (SpatialSeg, Eq. 4 and Fig. 6).

    Args:
        statistics: of a data set; the paper cuts it into nine rings.
        blocks: resamples of its images, for the bands.
        estimator: of the noise, which the paper leaves open; a key of ``statistics.noise``.
        average: "pooled" or "images", see `analysis.statistics.derive.AVERAGES`.

    Raises:
        InputError: an estimator or average that there is not.
    """
    check_choice("estimator", estimator, statistics.noise)
    check_choice("average", average, AVERAGES)
    mean, noise = statistics.mean, statistics.noise[estimator]
    values, bands = {}, {}
    for part in statistics.subsets():
        if average == "pooled":
            drawn = snr_of(blocks.mean(mean, part), blocks.mean(noise, part))
        else:
            drawn = blocks.mean(snr_of(mean, noise), part)
        for index, modality in enumerate(MODALITIES):
            values[modality, part] = region_snr(statistics, modality, part, estimator, average)
            bands[modality, part] = _band(blocks, drawn[:, index], part)
    return _made(f"signal-to-noise ratio ({estimator})", statistics, values, bands)


def _band(blocks: ConsecutiveBlocks, drawn: Floats, part: str) -> Floats:
    """(2, R) ends of the intervals of (1 + B, R) resampled values; NaN where there are none."""
    found = [blocks.interval(each, part, level=LEVEL, scale="ratio") for each in drawn.T]
    return np.array([[each.low for each in found], [each.high for each in found]])


def _made(
    measure: str,
    statistics: SpatialStatistics,
    values: Mapping[Key, Floats],
    bands: Mapping[Key, Floats],
) -> RegionSeries:
    middles = [float(np.nanmedian(values[modality, "all"])) for modality in MODALITIES]
    return RegionSeries(
        measure=measure,
        partition=statistics.partition,
        values=values,
        bands=bands,
        images={part: int(statistics.chosen(part).sum()) for part in statistics.subsets()},
        is_log=min(middles) > 0 and max(middles) > FAR_APART * min(middles),
    )


@styled
def draw(data: RegionSeries) -> Figure:
    """Six lines with intervals: modality by colour, part by marker and line."""
    figure = new_figure(COLUMN, 3.1)
    axes = figure.subplots()
    order = sorted(data.values, key=lambda key: MODALITIES.index(key[0]))
    for index, key in enumerate(order):
        shift = SPREAD * (index / max(1, len(order) - 1) - 0.5)
        _draw_series(axes, data, key, shift)
    region_axis(axes, len(data.values[order[0]]), f"region ({data.partition})")
    if data.is_log:
        log_axis(axes)
    else:
        axes.set_ylim(bottom=0)
    axes.set_ylabel(data.measure)
    numbers = ", ".join(f"{part} {count}" for part, count in data.images.items())
    axes.set_title(f"bars: 95 % over blocks of neighbouring images\n({numbers})", fontsize=SMALL)
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(NAMES))
    return figure


def _draw_series(axes: Axes, data: RegionSeries, key: Key, shift: float) -> None:
    modality, part = key
    colour = COLOURS[MODALITIES.index(modality)]
    marker, line = MARKS[part]
    values = data.values[key]
    places = np.arange(1, len(values) + 1) + shift
    low, high = data.bands[key]
    # A value may lie outside its interval by a rounding error, and no bar has a negative length.
    lengths = np.maximum([values - low, high - values], 0)
    style: dict[str, Any] = {
        "color": colour,
        "marker": marker,
        "linestyle": line,
        "elinewidth": 0.6,
    }
    style |= {"markerfacecolor": colour if part == "all" else "white"}
    axes.errorbar(places, values, lengths, label=f"{NAMES[modality]}, {part}", **style)
