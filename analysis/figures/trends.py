"""SpatialSeg, Fig. 2: how IoU, accuracy and sample occupancy change over three partitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import (
    APART,
    COLOURS,
    MARKERS,
    PAGE,
    new_figure,
    region_axis,
    say_splits,
    series_legend,
    styled,
)
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import class_mean, miou, recall

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

TITLES = {
    "vertical": "vertical (left to right)",
    "horizontal": "horizontal (top to bottom)",
    "ring": "rings (inside to outside)",
}


@dataclass(frozen=True)
class Trend:
    """Scores over the regions of one partition, percent.

    Attributes:
        partition: "vertical", "horizontal" or "ring".
        occupancy: (R,) sample occupancy rate (Eq. 2).
        ious: method -> (R,) mean IoU.
        accuracies: method -> (R,) mean class accuracy.
    """

    partition: str
    occupancy: NDArray[np.float64]
    ious: Mapping[str, NDArray[np.float64]]
    accuracies: Mapping[str, NDArray[np.float64]]

    def changes(self) -> dict[str, NDArray[np.float64]]:
        """Series -> (R,) value less that of region 1, percent points; as the figure shows them."""
        series = {f"IoU ({name})": values for name, values in self.ious.items()}
        series |= {f"Acc ({name})": values for name, values in self.accuracies.items()}
        series["SOR"] = self.occupancy
        return {name: values - values[0] for name, values in series.items()}


def trend(
    partition: str,
    occupancy: NDArray[np.float64],
    methods: Mapping[str, Counts],
    absent: Absent,
) -> Trend:
    """IoU and accuracy of methods beside the sample occupancy, over the regions of a partition.

    IoU and accuracy of a region are means over the scored classes, of the pixels of all images.
    Whether the paper counts the background is not stated; here it counts, as in its tables.

    Args:
        partition: "vertical", "horizontal" or "ring".
        occupancy: (R,) in 0..1.
        methods: label -> counts with R regions of that partition.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.

    Raises:
        InputError: counts of another partition.
    """
    expected = f"{partition}{len(occupancy)}"
    for label, counts in methods.items():
        if not counts.partition.startswith(expected) or counts.counts.shape[1] != len(occupancy):
            raise InputError(
                f"methods: '{label}' was counted over {counts.partition}, expected {expected}; "
                "score it again with that partition."
            )
    summed = {label: (counts.by_region(), counts.scored) for label, counts in methods.items()}
    return Trend(
        partition=partition,
        occupancy=100 * np.asarray(occupancy, np.float64),
        ious={label: 100 * miou(each, absent, scored) for label, (each, scored) in summed.items()},
        accuracies={
            label: 100 * class_mean(recall(each, absent), scored)
            for label, (each, scored) in summed.items()
        },
    )


@styled
def draw(trends: Sequence[Trend], splits: tuple[str, str]) -> Figure:
    """One panel per partition; methods by colour, IoU in full and accuracy in open markers.

    Args:
        trends: of the partitions.
        splits: that the occupancy and that the scores are of; shown where they differ.
    """
    figure = new_figure(PAGE, 2.5)
    panels = figure.subplots(1, len(trends), sharey=True, squeeze=False)[0]
    for index, (axes, each) in enumerate(zip(panels, trends, strict=True)):
        _draw_one(axes, each)
        axes.set_title(f"({'abc'[index]}) {TITLES[each.partition]}")
    panels[0].set_ylabel("change from region 1\n(percent points)")
    series_legend(figure, panels[0], columns=5)
    say_splits(figure, splits)
    return figure


def _draw_one(axes: Axes, data: Trend) -> None:
    places = np.arange(1, len(data.occupancy) + 1)
    labels = list(data.ious)
    axes.axhline(0, color="grey", linewidth=0.6)
    for name, values in data.changes().items():
        kind, _, method = name.removesuffix(")").partition(" (")
        if not method:
            axes.plot(places, values, color=APART, linestyle=":", marker="*", label=name, ms=5)
            continue
        index = labels.index(method)
        colour = COLOURS[index % len(COLOURS)]
        filled = kind == "IoU"
        axes.plot(
            places,
            values,
            color=colour,
            marker=MARKERS[index % len(MARKERS)],
            markerfacecolor=colour if filled else "white",
            linestyle="-" if filled else "--",
            label=name,
        )
    region_axis(axes, len(places))
