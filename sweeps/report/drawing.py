"""How the figures of a study are drawn: one function a figure, each for data that suffices.

Drawn on plain matplotlib figures: Optuna's own pictures leave pruned and failed trials out, cut
long parameter names and put all slices into one row. The contour is Optuna's (`study_figures`).
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from sweeps.report.axes import (
    Dimension,
    dimension,
    log_axis,
    new_figure,
    scale_axis,
    used_parameters,
    vertical_axis,
)
from sweeps.report.study_data import Importances, StudyData, short_names

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from optuna.trial import FrozenTrial

COMPLETE, BEST, PRUNED, FAILED, RUNNING = "#4477aa", "#222222", "#ee7733", "#aa3377", "#999999"
COLOURS = ("#4477aa", "#ee7733", "#228833", "#aa3377")
"""Of objectives, in order; readable with colour-blind eyes (Tol)."""

ABREAST = 4
"""Slices in one row."""

MISSING = -0.12
"""Height in parallel coordinates of a trial that does not have the parameter; values are 0..1."""

APART = 24.0
"""Pixels between two numbers written beside points of the Pareto front."""


def history(data: StudyData) -> Figure:
    """Objectives by trial with the best so far, and which trials were pruned or failed."""
    rows = len(data.metrics)
    figure = new_figure(8.0, 1.0 + 3.0 * rows)
    numbers = [trial.number for trial in data.complete]
    for index, axis in enumerate(figure.subplots(rows, 1, sharex=True, squeeze=False)[:, 0]):
        values = np.array([trial.values[index] for trial in data.complete])
        best = (np.maximum if data.maximize[index] else np.minimum).accumulate(values)
        axis.plot(numbers, values, "o", color=COMPLETE, markersize=5, label="complete")
        axis.step(numbers, best, where="post", color=BEST, linewidth=1.2, label="best so far")
        _mark_ends(axis, data)
        axis.set_ylabel(_direction(data, index))
        axis.grid(alpha=0.3)
    axis.set_xlabel("trial")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set_xlim(-1, data.trials[-1].number + 1)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def _mark_ends(axis: Axes, data: StudyData) -> None:
    """Trials without a value, at the lower edge."""
    edge = axis.get_xaxis_transform()
    styles = {"PRUNED": ("pruned", PRUNED, "|", 12), "FAIL": ("failed", FAILED, "x", 6)}
    for state, (word, colour, marker, size) in styles.items():
        numbers = [trial.number for trial in data.of_state(state)]
        if numbers:
            style: Any = {"color": colour, "markersize": size, "transform": edge, "label": word}
            axis.plot(numbers, [0.03] * len(numbers), marker, **style)


def importance_bars(data: StudyData, found: Importances) -> Figure:
    """Share of every parameter, a bar for each objective."""
    names = list(found.shares)
    count = len(data.metrics)
    figure = new_figure(8.0, 1.3 + (0.22 + 0.2 * count) * len(names))
    axis = figure.subplots()
    height = 0.8 / count
    for index, metric in enumerate(data.metrics):
        places = np.arange(len(names)) + (index - (count - 1) / 2) * height
        shares = [found.shares[name][index] for name in names]
        known = [0.0 if math.isnan(share) else share for share in shares]
        colour = COLOURS[index % len(COLOURS)]
        bars = axis.barh(places, known, 0.92 * height, color=colour, label=f"for {metric}")
        texts = ["-" if math.isnan(share) else f"{share:.0%}" for share in shares]
        axis.bar_label(bars, texts, padding=3, fontsize=8)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.margins(x=0.1)
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axis.set_xlabel("share of the importance (PED-ANOVA: reaching the best tenth)")
    figure.legend(loc="outside lower center", ncols=min(count, 3))
    return figure


def parallel(data: StudyData) -> Figure:
    """A line for each complete trial through its parameters and objectives; dark lines are best."""
    names = used_parameters(data)
    scores = [
        Dimension(metric, tuple(trial.values[index] for trial in data.complete))
        for index, metric in enumerate(data.metrics)
    ]
    dimensions = [*(dimension(data, name) for name in names), *scores]
    short = short_names(data.distributions)
    texts = [*(short[name] for name in names), *data.metrics]
    width = max(1.5, 0.4 + 0.08 * max(map(len, texts)))
    figure = new_figure(max(7.0, width * len(dimensions)), 5.0)
    axis = figure.subplots()
    heights = np.array([item.places() for item in dimensions])
    has_missing = bool(np.isnan(heights).any())
    heights = np.where(np.isnan(heights), MISSING, heights)
    colours, mappable = _by_first_objective(data)
    # The best last, so that they lie on top.
    for index in sorted(range(len(data.complete)), key=lambda i: data.rank(data.complete[i]))[::-1]:
        axis.plot(heights[:, index], color=colours[index], linewidth=1.1, alpha=0.75)
    for place, item in enumerate(dimensions):
        vertical_axis(axis, place, item.ticks())
    if has_missing:
        axis.text(-0.08, MISSING, "not set", ha="right", va="center", fontsize=8, color="#555555")
    logs = ["\n(log)" if item.is_log else "" for item in dimensions]
    axis.set_xticks(range(len(dimensions)), map(str.__add__, texts, logs))
    axis.set_xlim(-0.3, len(dimensions) - 0.5)
    axis.set_yticks([])
    axis.tick_params(length=0)
    axis.spines[:].set_visible(False)
    figure.colorbar(mappable, ax=axis, label=_direction(data, 0), pad=0.01)
    return figure


def _by_first_objective(data: StudyData) -> tuple[Any, Any]:
    """Colours of the complete trials, dark for the best, and what a colour bar is made from."""
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    values = np.array([trial.values[0] for trial in data.complete])
    colours = colormaps[_map_name(data.maximize[0])]
    mappable = ScalarMappable(Normalize(values.min(), values.max()), colours)
    return mappable.to_rgba(values), mappable


def _map_name(maximize: bool) -> str:
    return "viridis_r" if maximize else "viridis"


def slices(data: StudyData, index: int) -> Figure:
    """One objective over each parameter; later trials are darker."""
    names = used_parameters(data)
    columns = min(len(names), ABREAST)
    rows = math.ceil(len(names) / columns)
    figure = new_figure(max(4.5, 2.7 * columns + 0.8), 0.4 + 2.6 * rows)
    axes = figure.subplots(rows, columns, sharey=True, squeeze=False).ravel()
    values = np.array([trial.values[index] for trial in data.complete])
    numbers = [trial.number for trial in data.complete]
    for axis, name in zip(axes, names, strict=False):
        item = dimension(data, name)
        dots = axis.scatter(
            *(item.values, values),
            c=numbers,
            cmap=_blues(),
            edgecolors="#555555",
            linewidths=0.5,
            s=26,
        )
        scale_axis(axis, item)
        axis.set_xlabel(name + (" (log)" if item.is_log else ""), fontsize=9)
        axis.grid(alpha=0.3)
    for axis in axes[len(names) :]:
        axis.set_visible(False)
    figure.supylabel(_direction(data, index), fontsize=10)
    figure.colorbar(dots, ax=axes, label="trial", format="%d", ticks=_whole(numbers))
    return figure


def _blues() -> Any:
    """Blue from light, but visible on white, to dark."""
    from matplotlib import colormaps
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("blues", colormaps["Blues"](np.linspace(0.2, 1, 64)))


def _whole(numbers: Sequence[int]) -> list[int]:
    """A few of the trials' numbers, evenly over their range."""
    return sorted({round(number) for number in np.linspace(min(numbers), max(numbers), 5)})


def pareto(data: StudyData) -> Figure:
    """Every pair of objectives with the trials of the front marked by their numbers."""
    pairs = list(itertools.combinations(range(len(data.metrics)), 2))
    figure = new_figure(6.5 * len(pairs), 5.0)
    on_front = {trial.number for trial in data.front}
    others = [trial for trial in data.complete if trial.number not in on_front]
    for axis, (x, y) in zip(figure.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
        axis.plot(*_pair(others, x, y), "o", color=COMPLETE, alpha=0.5, label="complete")
        front = sorted(data.front, key=lambda trial: (trial.values[x], trial.values[y]))
        line = "-" if len(data.metrics) == 2 else ""
        axis.plot(*_pair(front, x, y), "o" + line, color=BEST, linewidth=0.8, label="Pareto front")
        axis.set(xlabel=_direction(data, x), ylabel=_direction(data, y))
        axis.grid(alpha=0.3)
        _number_points(axis, front, x, y)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


def _pair(trials: Sequence[FrozenTrial], x: int, y: int) -> tuple[list[float], list[float]]:
    return [trial.values[x] for trial in trials], [trial.values[y] for trial in trials]


def _number_points(axis: Axes, trials: Sequence[FrozenTrial], x: int, y: int) -> None:
    """Trial numbers beside points, left out where they would cover one another."""
    axis.autoscale_view()
    taken: list[Any] = []
    for trial in trials:
        point = (trial.values[x], trial.values[y])
        place = axis.transData.transform(point)
        if all(np.hypot(*(place - other)) >= APART for other in taken):
            taken.append(place)
            axis.annotate(str(trial.number), point, (5, 4), textcoords="offset points", fontsize=8)


def intermediate(data: StudyData) -> Figure:
    """What the trials reported while they trained; a cross where one was pruned."""
    figure = new_figure(8.0, 4.5)
    axis = figure.subplots()
    styles = {
        "RUNNING": ("running", RUNNING, "--"),
        "FAIL": ("failed", FAILED, ":"),
        "COMPLETE": ("complete", COMPLETE, "-"),
        "PRUNED": ("pruned", PRUNED, "-"),
    }
    for state, (word, colour, line) in styles.items():
        reported = [t for t in data.of_state(state) if t.intermediate_values]
        for rank, trial in enumerate(reported):
            steps, values = zip(*sorted(trial.intermediate_values.items()), strict=True)
            marker = "." if len(steps) > 1 else "o"
            style: Any = {"color": colour, "linestyle": line, "marker": marker, "markersize": 4}
            label = word if rank == 0 else None
            axis.plot(steps, values, linewidth=1.0, alpha=0.6, label=label, **style)
    ends = [
        max(t.intermediate_values.items()) for t in data.of_state("PRUNED") if t.intermediate_values
    ]
    if ends:
        axis.plot(*zip(*ends, strict=True), "x", color=PRUNED, markersize=7)
    axis.set(xlabel="training step", ylabel=f"reported: {_direction(data, 0)}")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4)
    return figure


def adjust_contour(axis: Axes, data: StudyData, index: int) -> None:
    """Optuna's contour in our colours (dark is best), its logarithmic axes readable."""
    axis.set_title("")
    for surface in axis.collections:
        if getattr(surface, "filled", False):
            surface.set_cmap(_map_name(data.maximize[index]))
    for which, name in (("x", axis.get_xlabel()), ("y", axis.get_ylabel())):
        item = dimension(data, name)
        if item.is_log:
            ends = axis.get_xlim() if which == "x" else axis.get_ylim()
            log_axis(axis, which, ends)


def _direction(data: StudyData, index: int) -> str:
    return f"{data.metrics[index]} ({'higher' if data.maximize[index] else 'lower'} is better)"
