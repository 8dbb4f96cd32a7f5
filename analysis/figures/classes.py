"""SpatialSeg, Fig. 3: where the samples of each class lie, beside the mIoU of each region."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput, check_one_dataset
from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.derive import class_region_occupancy, normalised
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.names import NIGHT
from rgbt.metrics.scores import miou


@dataclass(frozen=True)
class ClassRegions:
    """Shares of classes over the regions.

    Attributes:
        classes: J names, without the background.
        shares: (J, R) occupancy in percent of the region where the class is most frequent;
            NaN for a class that occurs nowhere.
        miou: (R,) percent of `method`, or None.
    """

    classes: tuple[str, ...]
    partition: str
    shares: NDArray[np.float64]
    part: str
    method: str | None
    miou: NDArray[np.float64] | None


def make(given: FigureInput) -> Figure:
    """Occupancy of each class, and mIoU, by region."""
    statistics = given.statistics(by_region=True)
    method, split = None, ""
    absent: Absent = "released"
    if "methods" not in given.values:
        given.refuse(["absent"], "methods=...")
    else:
        methods = given.counts("methods", statistics.partition)
        if len(methods) != 1:
            raise InputError(f"methods: {given.figure} shows one method, got {len(methods)}.")
        method = next(iter(methods.items()))
        check_one_dataset(statistics, method[1])
        absent, split = given.absent([method[1]]), method[1].split
    data = class_regions(statistics, given.get("part", ALL), method, absent)
    return draw(data, splits=(statistics.split, split))


def class_regions(
    statistics: SpatialStatistics,
    part: str = ALL,
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
        InputError: counts over other regions, or a part without images in data set or counts.
    """
    objects = list(statistics.objects)
    shares = 100 * normalised(class_region_occupancy(statistics, part)[objects])
    label, scores = None, None
    if method is not None:
        label, counts = method
        if counts.partition != statistics.partition:
            raise InputError(
                f"methods: '{label}' was counted over {counts.partition} but the statistics over "
                f"{statistics.partition}; score or measure with one partition."
            )
        if part != ALL:
            at_night = zip(counts.names, counts.night or (), strict=False)
            counts = counts.select(name for name, dark in at_night if dark == (part == NIGHT))
            if not counts.names:
                raise InputError(
                    f"part={part}: the counts of '{label}' contain no image of the {part}."
                )
        scores = 100 * miou(counts.by_region(), absent, counts.scored)
    return ClassRegions(
        classes=tuple(statistics.classes[index] for index in objects),
        partition=statistics.partition,
        shares=shares,
        part=part,
        method=label,
        miou=scores,
    )


@style.styled
def draw(data: ClassRegions, splits: tuple[str, str]) -> Figure:
    """One line per class, and the mIoU as a thick black line, all in percent on one axis.

    `splits` are those of the occupancy and of the mIoU, shown where they differ.
    """
    figure = style.new_figure(style.PAGE, 2.8)
    axes = figure.subplots()
    places = np.arange(1, data.shares.shape[1] + 1)
    for index, (name, shares) in enumerate(zip(data.classes, data.shares, strict=True)):
        missing = " (none)" if np.isnan(shares).all() else ""
        axes.plot(places, shares, label=style.readable(name) + missing, **style.series_style(index))
    if data.miou is not None:
        line: Any = {"color": style.APART, "linewidth": 2.2, "marker": "*", "markersize": 7}
        axes.plot(places, data.miou, label=f"mIoU ({data.method})", **line)
    images = "" if data.part == ALL else f"; images of the {data.part}"
    style.region_axis(axes, len(places), f"region ({data.partition}){images}")
    axes.set(ylim=(0, 105))
    more = "" if data.miou is None else "; mIoU (%)"
    axes.set_ylabel(f"SOR, percent of the class's\nlargest region{more}")
    figure.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    style.say_splits(figure, splits)
    return figure
