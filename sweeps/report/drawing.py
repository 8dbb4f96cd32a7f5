"""Figures of a study that Optuna does not draw so: each for data that suffices.

Optuna's history leaves pruned and failed trials out, its front has no numbers, its intermediate
values do not show how a trial ended, and its importances are computed anew. It draws the slices,
the contour and the parallel coordinates (`sweeps.report.figures`).
"""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from sweeps.report.study_data import Importances, StudyData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COMPLETE, BEST, PRUNED, FAILED, RUNNING = "#4477aa", "#222222", "#ee7733", "#aa3377", "#999999"
COLOURS = ("#4477aa", "#ee7733", "#228833", "#aa3377")
"""Of objectives, in order; readable with colour-blind eyes (Tol)."""

ENDS = {"PRUNED": ("pruned", PRUNED, "|", 12), "FAIL": ("failed", FAILED, "x", 6)}
"""How a trial without a value is marked at the lower edge: word, colour, marker, size."""

APART = 24.0
"""Pixels between two numbers written beside points of the Pareto front."""


def new_figure(width_inches: float, height_inches: float) -> Figure:
    """A figure without pyplot: no global state, no display, nothing to close."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


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
        edge = axis.get_xaxis_transform()
        for state, (word, colour, marker, size) in ENDS.items():
            ended = [trial.number for trial in data.of_state(state)]
            style: Any = {"color": colour, "markersize": size, "label": word if ended else None}
            axis.plot(ended, [0.03] * len(ended), marker, transform=edge, **style)
        axis.set_ylabel(data.direction(index))
        axis.grid(alpha=0.3)
    axis.set_xlabel("trial")
    axis.xaxis.get_major_locator().set_params(integer=True)
    axis.set_xlim(-1, data.trials[-1].number + 1)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=4)
    return figure


def importance_bars(data: StudyData, importances: Importances) -> Figure:
    """Share of every parameter, a bar for each objective."""
    names = list(importances.shares)
    count = len(data.metrics)
    figure = new_figure(8.0, 1.3 + (0.22 + 0.2 * count) * len(names))
    axis = figure.subplots()
    height = 0.8 / count
    for index, metric in enumerate(data.metrics):
        positions = np.arange(len(names)) + (index - (count - 1) / 2) * height
        shares = [importances.shares[name][index] for name in names]
        known = [0.0 if math.isnan(share) else share for share in shares]
        colour = COLOURS[index % len(COLOURS)]
        bars = axis.barh(positions, known, 0.92 * height, color=colour, label=f"for {metric}")
        texts = ["-" if math.isnan(share) else f"{share:.0%}" for share in shares]
        axis.bar_label(bars, texts, padding=3, fontsize=8)
    axis.set_yticks(range(len(names)), names)
    axis.invert_yaxis()
    axis.margins(x=0.1)
    axis.xaxis.set_major_formatter(lambda value, _: f"{value:.0%}")
    axis.set_xlabel("share of the importance (PED-ANOVA: reaching the best tenth)")
    figure.legend(loc="outside lower center", ncols=min(count, 3))
    return figure


def pareto(data: StudyData) -> Figure:
    """Every pair of objectives with the trials of the front marked by their numbers."""
    count = len(data.metrics)
    pairs = list(itertools.combinations(range(count), 2))
    figure = new_figure(6.5 * len(pairs), 5.0)
    others = [trial.values for trial in data.complete if trial not in data.front]
    beaten = np.array(others).reshape(-1, count)
    for axis, (x, y) in zip(figure.subplots(1, len(pairs), squeeze=False)[0], pairs, strict=True):
        axis.plot(beaten[:, x], beaten[:, y], "o", color=COMPLETE, alpha=0.5, label="complete")
        front = sorted(data.front, key=lambda trial: (trial.values[x], trial.values[y]))
        best = np.array([trial.values for trial in front])
        line = "o-" if count == 2 else "o"
        axis.plot(best[:, x], best[:, y], line, color=BEST, linewidth=0.8, label="Pareto front")
        axis.set(xlabel=data.direction(x), ylabel=data.direction(y))
        axis.grid(alpha=0.3)
        # Numbers of the trials, left out where they would cover one another.
        axis.autoscale_view()
        taken: list[Any] = []
        for trial in front:
            point = (trial.values[x], trial.values[y])
            position = axis.transData.transform(point)
            if all(np.hypot(*(position - other)) >= APART for other in taken):
                taken.append(position)
                offset: Any = {"textcoords": "offset points", "fontsize": 8}
                axis.annotate(str(trial.number), point, (5, 4), **offset)
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return figure


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
    axis.set(xlabel="training step", ylabel=f"reported: {data.direction(0)}")
    axis.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=4)
    return figure
