"""What a run says in the terminal: remarks on stderr; tables and where everything is on stdout."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from rich import box
from rich.console import Console, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rgbt.tracking.tables import Grid, ResultTables, result_grids

WIDTH = 240
"""Columns that a table may take; nine regions need about 110."""


def tell(sentence: str) -> None:
    """A line on stderr that is no error."""
    sys.stderr.write(f"rgbt: {sentence}\n")


def rich_table(grid: Grid) -> Table:
    """A grid as a rich table: labels left, numbers right."""
    table = Table(
        title=escape(grid.title), title_justify="left", title_style="bold", box=box.SIMPLE_HEAD
    )
    if grid.notes:
        table.caption, table.caption_justify = escape("\n".join(grid.notes)), "left"
    for index, name in enumerate(grid.header):
        table.add_column(escape(name), justify="right" if index else "left", no_wrap=True)
    for row in grid.rows:
        table.add_row(*map(escape, row))
    return table


def final_lines(folder: Path, links: Sequence[tuple[str, str]]) -> Text:
    """Where the run is, one "name  place" pair per line.

    Args:
        folder: the run folder.
        links: what the tracker answered (`links()`): (name, command or address).
    """
    return place_lines([("run folder", str(folder)), *links])


def place_lines(places: Sequence[tuple[str, str]]) -> Text:
    """Where things are, one "name  place" pair per line."""
    width = max(len(name) for name, _ in places)
    return Text("\n".join(f"{name:<{width}}  {place}" for name, place in places), no_wrap=True)


def result_view(
    tables: ResultTables, folder: Path, links: Sequence[tuple[str, str]]
) -> RenderableType:
    """Tables and places of a finished run."""
    return Group(*map(rich_table, result_grids(tables)), final_lines(folder, links))


def show(renderable: RenderableType) -> None:
    """Print results to stdout, never cut or wrapped, so that lines can be copied."""
    # Tables take the width they need; rich would cut them at the terminal's (a pipe counts as 80).
    Console(width=WIDTH).print(renderable, soft_wrap=True)
