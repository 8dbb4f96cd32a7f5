"""The figure of a computed table: ours with error bars over seeds, published values hollow beside.

Three forms: over the factor that the rows vary; rows below each other, one panel per column; or,
for tables of regions or classes without a mean, one panel per row over the columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.metrics import names
from sweeps.rendering.panel import OURS, PUBLISHED, Series, draw_pair, title_and_legend
from sweeps.table.parameter_counts import SCALE
from sweeps.table.scoring import ScoredTable, published
from sweeps.table.table import Column, Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

MAX_PANELS = 4
"""Columns of a table without headlines up to which each has a panel."""

HEADLINES = (names.MIOU, names.VAR, names.TC, names.CA, names.CA_RELEASED)
"""What a figure is about where a table has it, over all images, those of the day or the night."""

MAX_HEADLINES = 5
"""Of a table; those after them are left out of its figure."""

SHIFT = 0.13
"""How far published markers stand beside ours, in rows or columns."""


def draw_table(scored: ScoredTable, path: Path) -> bool:
    """Draw the figure as PNG.

    Args:
        scored: the table.
        path: the file.

    Returns:
        whether there was anything to draw.
    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = figure_of(scored)
    if figure is None:
        return False
    FigureCanvasAgg(figure)
    figure.savefig(path, dpi=150)
    return True


def main_columns(scored: ScoredTable) -> list[Column]:
    """What the figure shows: the headlines that the table has, else all of a few columns."""
    columns = [column for column in scored.table.columns if _has_values(scored, column)]
    chosen = [column for column in columns if _is_headline(column)]
    if chosen:
        return chosen[:MAX_HEADLINES]
    return columns if len(columns) <= MAX_PANELS else []


def _is_headline(column: Column) -> bool:
    *part, score = (column.metric or "").split("/")
    return score in HEADLINES and part in ([], [names.DAY], [names.NIGHT])


def figure_of(scored: ScoredTable) -> Figure | None:
    """The figure; None where there is no value at all."""
    if not any(_has_values(scored, column) for column in scored.table.columns):
        return None
    columns = main_columns(scored)
    if not columns:
        return _profiles(scored)
    with_x = [row for row in scored.table.rows if row.x is not None]
    return _over_factor(scored, columns) if len(with_x) > 1 else _by_row(scored, columns)


def _has_values(scored: ScoredTable, column: Column) -> bool:
    ours = (scored.cells.get((row.label, column.name)) for row in scored.table.rows)
    theirs = (published(row, column) for row in scored.table.rows)
    return any(cell is not None and not math.isnan(cell.mean) for cell in ours) or any(
        value is not None for value in theirs
    )


def _over_factor(scored: ScoredTable, columns: Sequence[Column]) -> Figure:
    from matplotlib.figure import Figure

    factor = scored.table.factor
    assert factor is not None, "rows have x only where the table has a factor"
    rows = sorted((r for r in scored.table.rows if r.x is not None), key=lambda row: row.x or 0.0)
    figure = Figure(figsize=(7.5, 1.2 + 2.4 * len(columns)), layout="constrained")
    panels = figure.subplots(len(columns), 1, sharex=True, squeeze=False)[:, 0]
    for axes, column in zip(panels, columns, strict=True):
        places = [row.x or 0.0 for row in rows]
        ours, theirs = _series(scored, [(row, column) for row in rows], places, places)
        lower, upper = draw_pair(axes, ours, theirs, across=False, joined=True)
        axes.set_ylabel(column.name)
        for row in scored.table.rows:
            if row.x is None:
                _level(scored, row, column, (lower, upper))
    last = panels[-1]
    last.set_xscale(factor.axis)
    last.set_xlabel(factor.name)
    last.set_xticks([row.x for row in rows], [f"{row.x:g}" for row in rows])
    last.minorticks_off()
    title_and_legend(figure, _title(scored))
    return figure


def _level(scored: ScoredTable, row: Row, column: Column, sides: tuple[Axes, Axes]) -> None:
    """A row outside the factor, such as the baseline, as a level."""
    cell = scored.cells.get((row.label, column.name))
    printed = published(row, column)
    if cell is not None and not math.isnan(cell.mean):
        sides[0].axhline(cell.mean, color=OURS, ls="--", lw=1, label=f"{row.label}, ours")
    if printed is not None:
        sides[1].axhline(printed, color=PUBLISHED, ls=":", lw=1, label=f"{row.label}, published")


def _by_row(scored: ScoredTable, columns: Sequence[Column]) -> Figure:
    from matplotlib.figure import Figure

    rows = scored.table.rows
    size = (2.2 + 3.2 * len(columns), 1.9 + 0.32 * len(rows))
    figure = Figure(figsize=(max(size[0], 6.4), size[1]), layout="constrained")
    panels = figure.subplots(1, len(columns), sharey=True, squeeze=False)[0]
    for axes, column in zip(panels, columns, strict=True):
        places = [float(index) for index in range(len(rows))]
        beside = [place + SHIFT for place in places]
        ours, theirs = _series(scored, [(row, column) for row in rows], places, beside)
        draw_pair(axes, ours, theirs, across=True, joined=False)
        axes.set_xlabel(column.name)
        axes.grid(axis="y", alpha=0.25)
    panels[0].set_yticks(range(len(rows)), [row.label for row in rows])
    panels[0].set_ylim(len(rows) - 0.5, -0.5)
    title_and_legend(figure, _title(scored))
    return figure


def _profiles(scored: ScoredTable) -> Figure:
    from matplotlib.figure import Figure

    columns = scored.table.columns
    rows = [row for row in scored.table.rows if any(row.values) or row.experiment is not None]
    abreast = min(4, len(rows))
    height = math.ceil(len(rows) / abreast)
    width = max(2.6, 0.28 * len(columns))
    figure = Figure(figsize=(0.6 + width * abreast, 1 + 2.1 * height), layout="constrained")
    panels = figure.subplots(height, abreast, sharex=True, squeeze=False).ravel()
    for axes, row in zip(panels, rows, strict=False):
        places = [float(index) for index in range(len(columns))]
        pairs = [(row, column) for column in columns]
        draw_pair(axes, *_series(scored, pairs, places, places), across=False, joined=True)
        axes.set_title(row.label, fontsize=9)
        rotation = 0 if max(len(column.name) for column in columns) <= 2 else 90
        axes.set_xticks(places, [column.name for column in columns], rotation=rotation)
        axes.tick_params(labelsize=7)
    for axes in panels[len(rows) :]:
        axes.set_visible(False)
    title_and_legend(figure, _title(scored))
    return figure


def _series(
    scored: ScoredTable,
    pairs: Sequence[tuple[Row, Column]],
    ours_at: Sequence[float],
    theirs_at: Sequence[float],
) -> tuple[Series, Series]:
    cells = [scored.cells.get((row.label, column.name)) for row, column in pairs]
    means = tuple(math.nan if cell is None else cell.mean for cell in cells)
    sds = tuple(math.nan if cell is None else cell.sd for cell in cells)
    printed = (published(row, column) for row, column in pairs)
    theirs = tuple(math.nan if value is None else value for value in printed)
    nothing = (math.nan,) * len(theirs)
    return Series(tuple(ours_at), means, sds), Series(tuple(theirs_at), theirs, nothing)


def _title(scored: ScoredTable) -> str:
    if not scored.seeds:
        counted = f"ours: counted at scale={SCALE}" if scored.cells else "published"
        return f"{scored.name} ({counted})"
    seeds = len(scored.seeds)
    spread = f", mean ± sd of {seeds} seeds" if seeds > 1 else f", seed {scored.seeds[0]}"
    return f"{scored.name} (ours: scale={scored.scale}{spread})"
