"""The figure of a table: ours with error bars over seeds, published values hollow beside."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.uncertainty.blocks import Values
from sweeps.plan.table import Column
from sweeps.score.cells import ScoredTable, TableCell, published
from sweeps.score.efficiency import SCALE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Blue and vermilion of Okabe and Ito, which colour-blind eyes tell apart.
OURS, PUBLISHED = "#0072B2", "#D55E00"
DOTS: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1, "capsize": 3, "ls": "none"}

# Most columns that are shown of a table without headlines, and most headlines.
MAX_PANELS, MAX_HEADLINES = 4, 5

# Shift of published markers below ours, in rows.
SHIFT = 0.13


def figure_of(scored: ScoredTable) -> Figure | None:
    """Draw the values of the main columns; None where there is no value at all."""
    from analysis.figures.plots import new_figure

    rows = scored.table.rows
    values = {column.name: _values(scored, column) for column in scored.table.columns}
    columns = []
    for column in scored.table.columns:
        if not np.isnan(values[column.name]).all():
            columns.append(column)
    shown = [column for column in scored.table.headlines() if column in columns][:MAX_HEADLINES]
    shown = shown or columns[:MAX_PANELS]
    if not shown:
        return None
    figure = new_figure(max(2.2 + 3.2 * len(shown), 6.4), 1.9 + 0.32 * len(rows))
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    places = np.arange(len(rows))
    for axes, column in zip(panels, shown, strict=True):
        means, sds, printed = values[column.name]
        bars = None if np.isnan(sds).all() else sds
        axes.errorbar(means, places, xerr=bars, **DOTS, color=OURS, label="ours")
        style = {**DOTS, "color": PUBLISHED, "mfc": "none", "label": "published"}
        axes.errorbar(printed, places + SHIFT, **style)
        axes.set_xlabel(column.name)
        axes.grid(alpha=0.25)
    panels[0].set_yticks(places, [row.label for row in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    ours = f"ours: counted at scale={SCALE}" if scored.cells else "published"
    if scored.seeds:
        many = len(scored.seeds)
        spread = f"mean ± sd of {many} seeds" if many > 1 else f"seed {scored.seeds[0]}"
        ours = f"ours: scale={scored.scale}, {spread}"
    figure.suptitle(f"{scored.name} ({ours})", fontsize=10)
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _values(scored: ScoredTable, column: Column) -> Values:
    """(3, R) mean and standard deviation of ours, and published value, of every row; NaN: none."""
    nothing = TableCell(math.nan, math.nan, 0)
    values = []
    for row in scored.table.rows:
        cell = scored.cells.get((row.label, column.name), nothing)
        printed = published(row, column)
        values.append((cell.mean, cell.sd, math.nan if printed is None else printed))
    return np.array(values, np.float64).T
