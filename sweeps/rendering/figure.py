"""The figure of a table: ours with error bars over seeds, published values hollow beside."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from analysis.uncertainty.blocks import Values
from sweeps.table.cells import ScoredTable, TableCell, published
from sweeps.table.efficiency import SCALE
from sweeps.table.table import Column

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Blue and vermilion of Okabe and Ito, which colour-blind eyes tell apart.
OURS, PUBLISHED = "#0072B2", "#D55E00"

# Two sets of values get an axis each where the gap between them is this many times their range.
FAR_APART = 2.0

# Columns of a table without headlines, and headlines, that are shown.
MAX_PANELS, MAX_HEADLINES = 4, 5

# Shift of published markers below ours, in rows.
SHIFT = 0.13


def write_figure(figure: Figure, path: Path) -> Path:
    """Write a figure as PNG or SVG; equal figures give equal bytes."""
    import matplotlib as mpl
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    FigureCanvasAgg(figure)
    path.parent.mkdir(parents=True, exist_ok=True)
    metadata = {"Date": None} if path.suffix == ".svg" else {}
    with mpl.rc_context({"svg.hashsalt": "rgbt", "svg.fonttype": "none"}):
        figure.savefig(path, dpi=150, metadata=metadata)
    return path


def figure_of(scored: ScoredTable) -> Figure | None:
    """The figure; None where there is no value at all."""
    from matplotlib.figure import Figure

    rows = scored.table.rows
    values = {column.name: _values(scored, column) for column in scored.table.columns}
    columns = [each for each in scored.table.columns if not np.isnan(values[each.name]).all()]
    shown = [each for each in scored.table.headlines() if each in columns][:MAX_HEADLINES]
    shown = shown or columns[:MAX_PANELS]
    if not shown:
        return None
    size = (max(2.2 + 3.2 * len(shown), 6.4), 1.9 + 0.32 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(shown), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, shown, strict=True):
        _draw(axes, *values[column.name])
        axes.set_xlabel(column.name)
    panels[0].set_yticks(range(len(rows)), [row.label for row in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    ours = f"ours: counted at scale={SCALE}" if scored.cells else "published"
    if scored.seeds:
        many = len(scored.seeds)
        spread = f"mean ± sd of {many} seeds" if many > 1 else f"seed {scored.seeds[0]}"
        ours = f"ours: scale={scored.scale}, {spread}"
    figure.suptitle(f"{scored.name} ({ours})", fontsize=10)
    handles: dict[str, Artist] = {}
    for axes in figure.axes:
        artists, labels = axes.get_legend_handles_labels()
        handles |= dict(zip(labels, artists, strict=True))
    artists, labels = list(handles.values()), list(handles)
    figure.legend(artists, labels, loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _values(scored: ScoredTable, column: Column) -> Values:
    """(3, R) mean and standard deviation of ours, and published value, of every row; NaN: none."""
    nothing, found = TableCell(math.nan, math.nan, 0), []
    for row in scored.table.rows:
        cell, printed = scored.cells.get((row.label, column.name), nothing), published(row, column)
        found.append((cell.mean, cell.sd, math.nan if printed is None else printed))
    return np.array(found, np.float64).T


def _draw(axes: Axes, means: Values, sds: Values, printed: Values) -> None:
    """Ours and the published values of a column; an axis each where they are far apart."""
    known = [each[~np.isnan(each)] for each in (means, printed)]
    other, places = axes, np.arange(len(means))
    if all(map(len, known)):
        gap = max(known[0].min() - known[1].max(), known[1].min() - known[0].max())
        if gap > FAR_APART * max(float(np.ptp(each)) for each in known):
            other = axes.twiny()
            axes.tick_params(axis="x", colors=OURS)
            other.tick_params(axis="x", colors=PUBLISHED)
            other.spines["top"].set_color(PUBLISHED)
            other.set_xlabel("published", color=PUBLISHED)
    style: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1, "capsize": 3, "ls": "none"}
    if len(known[0]):
        bars = None if np.isnan(sds).all() else sds
        axes.errorbar(means, places, xerr=bars, **style, color=OURS, label="ours")
    if len(known[1]):
        other.errorbar(
            printed, places + SHIFT, **style, color=PUBLISHED, mfc="none", label="published"
        )
    axes.grid(alpha=0.25)
