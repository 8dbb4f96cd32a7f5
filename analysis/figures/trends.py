"""SpatialSeg, Fig. 2: how IoU, accuracy and sample occupancy change over three partitions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput, check_one_dataset
from analysis.figures.maps import occupancy_over
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.scores import class_mean, miou, recall

TITLES = {
    "vertical": "vertical (left to right)",
    "horizontal": "horizontal (top to bottom)",
    "ring": "rings (inside to outside)",
}


@dataclass(frozen=True)
class Trend:
    """Scores over the regions of one partition, percent.

    Attributes:
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


def make(given: FigureInput) -> Figure:
    """IoU, accuracy and occupancy over three partitions."""
    regions = given.get("regions", 5)
    counts = {each: given.counts("methods", f"{each}{regions}") for each in TITLES}
    absent = given.absent(each for methods in counts.values() for each in methods.values())
    statistics = given.statistics()
    of_methods = next(iter(counts["ring"].values()))
    check_one_dataset(statistics, of_methods)
    height, width = statistics.region_map.shape
    series = []
    for partition, methods in counts.items():
        chosen: Any = {"partition": partition, "aspect": "image" if partition == "ring" else None}
        cut = Regions(regions=regions, absent=absent, **chosen)
        occupancy = occupancy_over(statistics, cut.map((height, width)))
        series.append(trend(partition, occupancy, methods, absent))
    return draw(series, splits=(statistics.split, of_methods.split))


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
        partition: a key of `TITLES`.
        occupancy: (R,) in 0..1.
        methods: label -> counts; InputError if they are not over R regions of that partition.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.
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


@style.styled
def draw(trends: Sequence[Trend], splits: tuple[str, str]) -> Figure:
    """One panel per partition; methods by colour, IoU in full and accuracy in open markers.

    `splits` are those of the occupancy and of the scores, shown where they differ.
    """
    figure = style.new_figure(style.PAGE, 2.5)
    panels = figure.subplots(1, len(trends), sharey=True, squeeze=False)[0]
    for letter, axes, data in zip("abc", panels, trends, strict=False):
        axes.set_title(f"({letter}) {TITLES[data.partition]}")
        axes.axhline(0, color="grey", linewidth=0.6)
        places, changes = np.arange(1, len(data.occupancy) + 1), data.changes()
        for kind, line in (("IoU", "-"), ("Acc", "--")):
            for index, method in enumerate(data.ious):
                name, colour = f"{kind} ({method})", style.COLOURS[index % len(style.COLOURS)]
                how = {"color": colour, "marker": style.MARKERS[index % len(style.MARKERS)]}
                how |= {"markerfacecolor": colour if kind == "IoU" else "white"}
                axes.plot(places, changes[name], linestyle=line, label=name, **how)
        how = {"color": style.APART, "linestyle": ":", "marker": "*", "label": "SOR"}
        axes.plot(places, changes["SOR"], ms=5, **how)
        style.region_axis(axes, len(places))
    panels[0].set_ylabel("change from region 1\n(percent points)")
    style.series_legend(figure, panels[0], columns=5)
    style.say_splits(figure, splits)
    return figure
