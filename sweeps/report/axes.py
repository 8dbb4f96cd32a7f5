"""Axes of the figures of a study: parameters of any kind as numbers, places and few clear ticks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from sweeps.report.study_data import StudyData, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna.distributions import BaseDistribution


def new_figure(width_inches: float, height_inches: float) -> Figure:
    """A figure without pyplot: no global state, no display, nothing to close."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


@dataclass(frozen=True)
class Dimension:
    """One quantity of all complete trials, as numbers.

    Attributes:
        name: of the parameter or objective.
        values: by trial; a category is its place among the categories; NaN: the trial has none.
        is_log: whether it is searched on a logarithmic scale.
        categories: their names; (): the values are numbers.
        is_integer: whether there is nothing between whole numbers.
    """

    name: str
    values: tuple[float, ...]
    is_log: bool = False
    categories: tuple[str, ...] = ()
    is_integer: bool = False

    def places(self) -> np.ndarray[Any, np.dtype[np.float64]]:
        """Values scaled to 0..1; 0.5 where all are one; NaN where the trial has none."""
        low, high = self._ends()
        scaled = self._scaled(np.asarray(self.values, np.float64))
        return np.full_like(scaled, 0.5) if high == low else (scaled - low) / (high - low)

    def ticks(self) -> list[tuple[float, str]]:
        """(place in 0..1, text) of a few values."""
        from matplotlib.ticker import MaxNLocator

        low, high = self._ends()
        if self.categories:
            steps = max(len(self.categories) - 1, 1)
            single = len(self.categories) == 1
            return [
                (0.5 if single else index / steps, text)
                for index, text in enumerate(self.categories)
            ]
        if high == low:
            return [(0.5, shown(float(10**low if self.is_log else low)))]
        if self.is_log:
            values = log_locator(high - low).tick_values(10**low, 10**high)
        else:
            values = MaxNLocator(5, integer=self.is_integer).tick_values(low, high)
        places = (self._scaled(np.asarray(values, np.float64)) - low) / (high - low)
        return [
            (float(p), f"{v:.3g}")
            for p, v in zip(places, values, strict=True)
            if -0.01 <= p <= 1.01
        ]

    def _scaled(self, values: Any) -> Any:
        return np.log10(values) if self.is_log else values

    def _ends(self) -> tuple[float, float]:
        if self.categories:
            return 0.0, float(len(self.categories) - 1)
        scaled = self._scaled(np.asarray(self.values, np.float64))
        return float(np.nanmin(scaled)), float(np.nanmax(scaled))


def dimension(data: StudyData, name: str) -> Dimension:
    """A parameter of the complete trials; at least one of them has it."""
    distribution = data.distributions[name]
    choices = getattr(distribution, "choices", None)
    if choices is None:
        found = (float(trial.params.get(name, math.nan)) for trial in data.complete)
        is_log, is_integer = bool(getattr(distribution, "log", False)), _is_integer(distribution)
        return Dimension(name, tuple(found), is_log=is_log, is_integer=is_integer)
    places = [
        float(choices.index(trial.params[name])) if name in trial.params else math.nan
        for trial in data.complete
    ]
    return Dimension(name, tuple(places), categories=tuple(map(data.shown, choices)))


def _is_integer(distribution: BaseDistribution) -> bool:
    from optuna.distributions import IntDistribution

    return isinstance(distribution, IntDistribution)


def used_parameters(data: StudyData) -> list[str]:
    """Parameters that some complete trial has."""
    return [n for n in data.distributions if any(n in trial.params for trial in data.complete)]


def scale_axis(axis: Axes, item: Dimension) -> None:
    """The axis of a parameter: categories by name, few numbers on a narrow picture."""
    from matplotlib.ticker import MaxNLocator

    if item.categories:
        axis.set_xticks(range(len(item.categories)), item.categories)
        axis.set_xlim(-0.5, len(item.categories) - 0.5)
        if sum(map(len, item.categories)) > 18:
            axis.tick_params(axis="x", labelrotation=30)
    elif item.is_log:
        log_axis(axis, "x", item.values)
    else:
        axis.xaxis.set_major_locator(MaxNLocator(4, integer=item.is_integer))


def log_axis(axis: Axes, which: str, values: Sequence[float]) -> None:
    """A logarithmic axis with few numbers, written out."""
    from matplotlib.ticker import FuncFormatter, NullFormatter

    known = [value for value in values if not math.isnan(value)]
    (axis.set_xscale if which == "x" else axis.set_yscale)("log")
    line = axis.xaxis if which == "x" else axis.yaxis
    line.set_minor_formatter(NullFormatter())
    line.set_major_locator(log_locator(math.log10(max(known) / min(known))))
    line.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))


def log_locator(decades: float) -> Any:
    """Places of about three to six numbers on a logarithmic axis of that many decades."""
    from matplotlib.ticker import LogLocator, MaxNLocator

    if decades < 0.5:
        return MaxNLocator(4)
    subs = (1, 2, 5) if decades < 1.1 else (1, 3) if decades < 2 else (1,)
    return LogLocator(subs=subs, numticks=7)


def vertical_axis(axis: Axes, place: int, ticks: Sequence[tuple[float, str]]) -> None:
    """One of the parallel coordinates; `ticks` as of `Dimension.ticks`."""
    axis.axvline(place, 0.0, 1.0, color="#555555", linewidth=0.8, zorder=3)
    box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 0.8}
    for height, text in ticks:
        axis.plot([place, place + 0.03], [height, height], color="#555555", linewidth=0.8, zorder=3)
        axis.text(place + 0.05, height, text, va="center", fontsize=8, bbox=box, zorder=4)
