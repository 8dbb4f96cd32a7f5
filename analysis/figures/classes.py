"""SpatialSeg, Fig. 3: where the samples of each class lie, beside the mIoU of each region."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import (
    APART,
    PAGE,
    new_figure,
    readable,
    region_axis,
    say_splits,
    series_style,
    styled,
)
from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.derive import class_region_occupancy, normalised
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.names import NIGHT
from rgbt.metrics.scores import miou

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class ClassRegions:
    """Shares of classes over the regions.

    Attributes:
        classes: K - 1 names, without the background.
        shares: (K - 1, R) occupancy in percent of the region where the class is most frequent;
            NaN for a class that occurs nowhere.
        part: of the images, "all", "day" or "night".
        method: whose IoU `miou` is, or None.
        miou: (R,) percent, or None.
    """

    classes: tuple[str, ...]
    partition: str
    shares: NDArray[np.float64]
    part: str
    method: str | None
    miou: NDArray[np.float64] | None


def class_regions(
    statistics: SpatialStatistics,
    part: str = "all",
    method: tuple[str, Counts] | None = None,
    absent: Absent = "released",
) -> ClassRegions:
    """The series of Fig. 3.

        share_kr = 100 SOR_kr / max_r SOR_kr

    Args:
        statistics: of a data set; the paper cuts it into nine rings.
        part: "all", "day" or "night", of the shares and of the mIoU.
        method: label and counts of a method over the same regions; None: no mIoU is drawn. The
            mean is over all scored classes with the background, which the paper does not state.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.

    Raises:
        InputError: counts over other regions, or a part that the data set or the counts lack.
    """
    shares = 100 * normalised(class_region_occupancy(statistics, part)[1:])
    scores = None
    if method is not None:
        label, counts = method
        if counts.partition != statistics.partition:
            raise InputError(
                f"methods: '{label}' was counted over {counts.partition} but the statistics over "
                f"{statistics.partition}; score or measure with one partition."
            )
        by_region = _of_part(label, counts, part).by_region()
        scores = 100 * miou(by_region, absent, counts.scored)
    return ClassRegions(
        classes=tuple(statistics.classes[1:]),
        partition=statistics.partition,
        shares=shares,
        part=part,
        method=None if method is None else method[0],
        miou=scores,
    )


def _of_part(label: str, counts: Counts, part: str) -> Counts:
    if part == ALL:
        return counts
    night = counts.night or [None] * len(counts.names)
    of_part = [dark == (part == NIGHT) for dark in night]
    chosen = [name for name, take in zip(counts.names, of_part, strict=True) if take]
    if not chosen:
        raise InputError(f"part={part}: the counts of '{label}' hold no image of the {part}.")
    return counts.select(chosen)


@styled
def draw(data: ClassRegions, splits: tuple[str, str]) -> Figure:
    """One line per class, and the mIoU as a thick black line, all in percent on one axis.

    Args:
        data: the series.
        splits: that the occupancy and that the mIoU are of; shown where they differ.
    """
    figure = new_figure(PAGE, 2.8)
    axes = figure.subplots()
    places = np.arange(1, data.shares.shape[1] + 1)
    for index, (name, shares) in enumerate(zip(data.classes, data.shares, strict=True)):
        missing = " (none)" if np.isnan(shares).all() else ""
        axes.plot(places, shares, label=readable(name) + missing, **series_style(index))
    if data.miou is not None:
        line = {"color": APART, "linewidth": 2.2, "marker": "*", "markersize": 7}
        axes.plot(places, data.miou, label=f"mIoU ({data.method})", **line)  # type: ignore[arg-type]
    images = "" if data.part == ALL else f"; images of the {data.part}"
    region_axis(axes, len(places), f"region ({data.partition}){images}")
    axes.set(ylim=(0, 105))
    axes.set_ylabel("SOR, percent of the class's\nlargest region" + _and_iou(data))
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    say_splits(figure, splits)
    return figure


def _and_iou(data: ClassRegions) -> str:
    return "" if data.miou is None else "; mIoU (%)"
