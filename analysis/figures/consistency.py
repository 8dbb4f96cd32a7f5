"""Temporal, Fig. 5: temporal consistency (TC) and consistent accuracy (CA) by class."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError
from rgbt.metrics import names
from rgbt.metrics.counts import Counts, check_same_means, scored_classes
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import value
from rgbt.metrics.pairs import HEADLINES, Protocol, protocol_of
from rgbt.metrics.scores import class_mean
from rgbt.tables import class_labels

TITLES: dict[Protocol, str] = {
    "aligned": "virtual views, first frame warped into the second",
    "released": "virtual views, frames not warped (as released)",
    "next": "consecutive frames",
}


@dataclass(frozen=True)
class ClassConsistency:
    """TC and CA of V variants, e.g. "(G) Ours-dice", by C classes.

    Attributes:
        unscored: names of the classes that are left out of the means.
        tc: (V, C) percent, temporal consistency, mean over seeds; NaN: nothing to score.
        ca: (V, C) percent, consistent accuracy by the union of the protocol; never above `tc`,
            whose numerator holds its own and whose denominator its own holds (Temporal, Fig. 4).
    """

    protocol: Protocol
    classes: tuple[str, ...]
    variants: tuple[str, ...]
    unscored: tuple[str, ...]
    tc: NDArray[np.float64]
    ca: NDArray[np.float64]

    def means(self) -> dict[str, tuple[float, float]]:
        """Variant -> mean TC and CA over scored classes: the cells of the paper's Table I."""
        scored = scored_classes(self.classes, self.unscored)
        tcs, cas = (class_mean(values, scored) for values in (self.tc, self.ca))
        rows = zip(self.variants, tcs, cas, strict=True)
        return {name: (float(tc), float(ca)) for name, tc, ca in rows}


def make(given: FigureInput) -> Figure:
    """TC and CA by class."""
    frames: Any = given.get("frames", "aligned")
    runs = given.runs(frames)
    absent = given.absent(counts for seeds in runs.values() for counts in seeds)
    return draw(class_consistency(runs, absent))


def class_consistency(methods: Mapping[str, Sequence[Counts]], absent: Absent) -> ClassConsistency:
    """The series of Fig. 5.

    Args:
        methods: variant -> counts of pairs of frames of its seeds.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.

    Raises:
        InputError: counts of single frames, or of different protocols, classes or scored classes.
    """
    every = [(label, counts) for label, seeds in methods.items() for counts in seeds]
    (first, reference), *others = every
    for label, counts in others:
        if (counts.partition, counts.classes) != (reference.partition, reference.classes):
            raise InputError(
                f"runs: '{first}' was counted by {reference.partition} over "
                f"{', '.join(reference.classes)}, but '{label}' by {counts.partition} over "
                f"{', '.join(counts.classes)}; give counts of one protocol and data set."
            )
        check_same_means(reference, counts)
    protocol = protocol_of(reference.partition)
    if protocol is None:
        raise InputError(
            f"runs: the counts of '{first}' ({reference.partition}) are of single frames; python "
            "-m rgbt.consistency run=... counts the pairs of a run."
        )

    def by_class(seeds: Sequence[Counts], score: str) -> NDArray[np.float64]:
        metrics = [names.of_class(name, score) for name in reference.classes]
        by_seed = [[value(metric, counts, absent) for metric in metrics] for counts in seeds]
        return np.asarray(np.mean(by_seed, axis=0), np.float64)

    tc, ca = (
        np.array([by_class(seeds, score) for seeds in methods.values()])
        for score in HEADLINES[protocol]
    )
    return ClassConsistency(protocol, reference.classes, tuple(methods), reference.unscored, tc, ca)


@style.styled
def draw(data: ClassConsistency) -> Figure:
    """TC as full and CA as open marker, joined by a line; variants side by side in each class.

    The legend holds the means over classes.
    """
    figure = style.new_figure(style.PAGE, 2.6)
    axes = figure.subplots()
    places = np.arange(len(data.classes))
    step = min(0.2, 0.7 / len(data.variants))
    union = " (released)" if HEADLINES[data.protocol][1] == names.CA_RELEASED else ""
    for index, (variant, (tc, ca)) in enumerate(data.means().items()):
        x = places + (index - (len(data.variants) - 1) / 2) * step
        colour = style.COLOURS[index % len(style.COLOURS)]
        mark: Any = {
            "marker": style.MARKERS[index % len(style.MARKERS)],
            "linestyle": "none",
            "color": colour,
        }
        axes.vlines(x, data.ca[index], data.tc[index], color=colour, linewidth=0.8)
        label = f"{variant} (TC {tc:.1f}, CA {ca:.1f})"
        axes.plot(x, data.tc[index], label=label, clip_on=False, **mark)
        axes.plot(x, data.ca[index], markerfacecolor="white", clip_on=False, **mark)
    labels = class_labels(data.classes, data.unscored)
    axes.set_xticks(places, [style.readable(label).replace(" (", "\n(") for label in labels])
    axes.grid(visible=False, axis="x")
    axes.set_ylim(bottom=0)
    axes.set_ylabel(f"percent: TC full,\nCA{union} open")
    axes.set_title(TITLES[data.protocol], fontsize=style.SMALL)
    style.series_legend(figure, axes, columns=len(data.variants))
    return figure
