"""The figure of a computed table: ours with error bars over seeds, published values hollow beside.

Two forms: over the factor that the rows vary; or rows below each other, one panel per column.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from sweeps.table.cells import ScoredTable, published
from sweeps.table.efficiency import SCALE
from sweeps.table.table import Column, Row

if TYPE_CHECKING:
    from matplotlib.artist import Artist
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

OURS, PUBLISHED = "#0072B2", "#D55E00"
"""Blue and vermilion of Okabe and Ito, which colour-blind eyes tell apart."""

FAR_APART = 2.0
"""Two sets of values get an axis each where the gap between them is this many times their range."""

MAX_PANELS, MAX_HEADLINES = 4, 5
"""Columns of a table without headlines, and headlines, that are shown."""

SHIFT = 0.13
"""Shift of published markers beside ours, in rows or columns."""


class Series(NamedTuple):
    """Values along an axis and half lengths of their error bars; NaN: there is none."""

    positions: Sequence[float]
    means: Sequence[float]
    sds: Sequence[float]

    def known(self) -> list[float]:
        """The finite values."""
        return [mean for mean in self.means if not math.isnan(mean)]


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
    rows = scored.table.rows
    columns = [each for each in scored.table.columns if any(_values(scored, rows, each))]
    if not columns:
        return None
    shown = [each for each in scored.table.headlines() if each in columns][:MAX_HEADLINES]
    shown = shown or columns[:MAX_PANELS]
    with_x = [row for row in rows if row.x is not None]
    return _over_factor(scored, shown) if len(with_x) > 1 else _by_row(scored, shown)


def _values(scored: ScoredTable, rows: Sequence[Row], column: Column) -> list[bool]:
    """Whether there is a value of ours or of the paper, by row."""
    cells = [scored.cells.get((row.label, column.name)) for row in rows]
    ours = [cell is not None and not math.isnan(cell.mean) for cell in cells]
    return [
        each or published(row, column) is not None for each, row in zip(ours, rows, strict=True)
    ]


def _over_factor(scored: ScoredTable, columns: Sequence[Column]) -> Figure:
    from matplotlib.figure import Figure

    factor = scored.table.factor
    assert factor is not None, "rows have x only where the table has a factor"
    rows = sorted((r for r in scored.table.rows if r.x is not None), key=lambda row: row.x or 0.0)
    figure = Figure(figsize=(7.5, 1.2 + 2.4 * len(columns)), layout="constrained")
    panels = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
    for axes, column in zip(panels, columns, strict=True):
        positions = [row.x or 0.0 for row in rows]
        series = _series(scored, [(row, column) for row in rows], positions)
        lower, upper = _draw_pair(axes, *series, across=False, joined=True)
        axes.set_ylabel(column.name)
        # Rows outside the factor, such as the baseline, are levels.
        for row in (row for row in scored.table.rows if row.x is None):
            cell = scored.cells.get((row.label, column.name))
            if cell is not None and not math.isnan(cell.mean):
                lower.axhline(cell.mean, color=OURS, ls="--", lw=1, label=f"{row.label}, ours")
            printed = published(row, column)
            if printed is not None:
                label = f"{row.label}, published"
                upper.axhline(printed, color=PUBLISHED, ls=":", lw=1, label=label)
    last = panels[-1]
    last.set_xscale(factor.axis)
    last.set_xlabel(factor.name)
    last.set_xticks([row.x for row in rows], [f"{row.x:g}" for row in rows])
    last.minorticks_off()
    return _finished(figure, scored)


def _by_row(scored: ScoredTable, columns: Sequence[Column]) -> Figure:
    from matplotlib.figure import Figure

    rows = scored.table.rows
    size = (max(2.2 + 3.2 * len(columns), 6.4), 1.9 + 0.32 * len(rows))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        series = _series(scored, [(row, column) for row in rows], range(len(rows)), SHIFT)
        _draw_pair(axes, *series, across=True, joined=False)
        axes.set_xlabel(column.name)
        axes.grid(axis="y", alpha=0.25)
    panels[0].set_yticks(range(len(rows)), [row.label for row in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    return _finished(figure, scored)


def _series(
    scored: ScoredTable,
    pairs: Sequence[tuple[Row, Column]],
    positions: Sequence[float],
    shift: float = 0.0,
) -> tuple[Series, Series]:
    """Ours, and the published values `shift` beside them."""
    cells = [scored.cells.get((row.label, column.name)) for row, column in pairs]
    means = [math.nan if cell is None else cell.mean for cell in cells]
    sds = [math.nan if cell is None else cell.sd for cell in cells]
    printed = (published(row, column) for row, column in pairs)
    theirs = [math.nan if value is None else value for value in printed]
    beside = [position + shift for position in positions]
    return Series(positions, means, sds), Series(beside, theirs, [math.nan] * len(theirs))


def _draw_pair(
    axes: Axes, ours: Series, theirs: Series, *, across: bool, joined: bool
) -> tuple[Axes, Axes]:
    """Both series in one panel; the axes of ours and of the published values.

    With `across`, values run to the right and places down, instead of values up.
    """
    other, (mine, printed) = axes, (ours.known(), theirs.known())
    gap = max(min(mine) - max(printed), min(printed) - max(mine)) if mine and printed else 0.0
    widest = max((max(each) - min(each) for each in (mine, printed) if each), default=0.0)
    if gap > max(0.0, FAR_APART * widest):  # one axis for both would press each into a line
        other = axes.twiny() if across else axes.twinx()
        side, second = ("x", "top") if across else ("y", "right")
        axes.tick_params(axis=side, colors=OURS)  # type: ignore[arg-type]
        other.tick_params(axis=side, colors=PUBLISHED)  # type: ignore[arg-type]
        other.spines[second].set_color(PUBLISHED)
        other.set(**{f"{side}label": "published"})
        getattr(other, f"{side}axis").label.set_color(PUBLISHED)
    style: dict[str, Any] = {"fmt": "o", "ms": 5, "lw": 1, "capsize": 3}
    style["ls"] = "-" if joined else "none"
    named = [(axes, ours, OURS, "ours", OURS), (other, theirs, PUBLISHED, "published", "none")]
    for target, series, colour, label, face in named:
        if not series.known():
            continue
        bars = None if all(map(math.isnan, series.sds)) else series.sds
        x, y = (series.means, series.positions) if across else (series.positions, series.means)
        xerr, yerr = (bars, None) if across else (None, bars)
        target.errorbar(x, y, yerr, xerr, **style, color=colour, mfc=face, label=label)
    axes.grid(axis="x" if across else "y", alpha=0.25)
    return axes, other


def _finished(figure: Figure, scored: ScoredTable) -> Figure:
    """With a title above all panels, and below them one legend for all."""
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
