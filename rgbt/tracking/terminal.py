"""What commands print: messages on stderr, tables and paths on stdout."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from rich import box
from rich.cells import cell_len
from rich.console import Console, ConsoleOptions, Group, RenderableType
from rich.markup import escape
from rich.table import Table
from rich.text import Text

from rgbt.tracking.column_layout import SHORTEST, blocks, is_text, shortened
from rgbt.tracking.tables import ResultTables, TextTable, result_grids

WIDTH = 10_000
"""Columns where stdout is no terminal: a file takes lines of any length."""

GAP = 3
"""Characters between two columns of a rich table."""

EDGES = 4
"""Characters beside the first and the last column together."""


Column = tuple[str, ...]
"""Header and cells of a column."""


def info(sentence: str) -> None:
    """Print a message to stderr."""
    sys.stderr.write(f"rgbt: {sentence}\n")


def warn(sentence: str) -> None:
    """Print a warning to stderr."""
    info(f"warning: {sentence}")


def rich_table(grid: TextTable) -> RenderableType:
    """A grid as a table that fits the console: labels and sentences left, numbers right."""
    return _FittedTable(grid)


@dataclass(frozen=True)
class _FittedTable:
    grid: TextTable

    def __rich_console__(
        self, console: Console, options: ConsoleOptions
    ) -> Iterator[RenderableType]:
        del console
        for grid in fitted(self.grid, options.max_width):
            # Not the table's own title, which would be broken at the width of the table.
            yield from [Text(grid.title, "bold")] if grid.title else []
            yield _table(grid)
        if self.grid.notes:
            yield Text("\n".join(f" {note}" for note in self.grid.notes), "dim")


def _table(grid: TextTable) -> Table:
    table = Table(box=box.SIMPLE_HEAD)
    for index, (name, *cells) in enumerate(zip(grid.header, *grid.rows, strict=True)):
        is_left = index == 0 or any(map(is_text, cells))
        table.add_column(escape(name), justify="left" if is_left else "right", no_wrap=True)
    for row in grid.rows:
        table.add_row(*map(escape, row))
    return table


def fitted(grid: TextTable, width: int) -> list[TextTable]:
    """A grid whose lines take at most `width` characters, as one or several below each other.

    Words are shortened first: labels, headers and sentences. Where that is not enough, the last
    columns are folded into a second grid with the same labels. Numbers and paths are never cut.
    """
    room = width - EDGES
    columns = list(zip(grid.header, *grid.rows, strict=True))
    limits = [_width(cells) for cells in columns]
    for index in _widest_words_first(columns):
        over = _taken(_cut_to(columns, limits)) - room
        fixed = [len(cell) for cell in columns[index][1:] if index and not is_text(cell)]
        limits[index] = max(SHORTEST, *fixed, limits[index] - max(over, 0))
    if _taken(_cut_to(columns, limits)) > room:  # folded in any case: no need to cut all
        limits = [max(SHORTEST, room // (2 if index else 3)) for index in range(len(columns))]
    columns = _cut_to(columns, limits)
    folded = blocks([_width(cells) for cells in columns], room, gap=GAP, first=1)
    return [
        _part(columns, indices, "" if number else grid.title)
        for number, indices in enumerate(folded)
    ]


def _widest_words_first(columns: Sequence[Column]) -> list[int]:
    """Columns that hold words, the labels among them."""
    words = [n for n, cells in enumerate(columns) if n == 0 or any(map(is_text, cells))]
    return sorted(words, key=lambda n: -_width(columns[n]))


def _cut_to(columns: Sequence[Column], limits: Sequence[int]) -> list[Column]:
    """Columns with their words cut to `limits` characters; what is no text keeps its width."""
    headers = [column[0] for column in columns]
    cut = _words_cut(headers, limits, every=False)
    bodies = [
        _words_cut(cells, [limit] * len(cells), every=index == 0)
        for index, ((_, *cells), limit) in enumerate(zip(columns, limits, strict=True))
    ]
    return [(name, *cells) for name, cells in zip(cut, bodies, strict=True)]


def _words_cut(cells: Sequence[str], limits: Sequence[int], *, every: bool) -> list[str]:
    words = {
        cell: limit for cell, limit in zip(cells, limits, strict=True) if every or is_text(cell)
    }
    short = dict(zip(words, shortened(list(words), list(words.values())), strict=True))
    return [short.get(cell, cell) for cell in cells]


def _part(columns: Sequence[Column], indices: Sequence[int], title: str) -> TextTable:
    header, *rows = zip(*(columns[index] for index in indices), strict=True)
    return TextTable(title, header, tuple(rows))


def _taken(columns: Sequence[Column]) -> int:
    return sum(map(_width, columns)) + GAP * (len(columns) - 1)


def _width(cells: Column) -> int:
    return max(map(cell_len, cells))


def line_width() -> int:
    """Characters of a line on stdout: of the terminal, or as many as there are in a file."""
    return Console().width if sys.stdout.isatty() else WIDTH


def path_lines(paths: Sequence[tuple[str, str]]) -> Text:
    """Paths, commands and addresses, one "name  path" pair per line."""
    width = max(len(name) for name, _ in paths)
    return Text("\n".join(f"{name:<{width}}  {path}" for name, path in paths), no_wrap=True)


def result_view(
    tables: ResultTables, folder: Path, links: Sequence[tuple[str, str]]
) -> RenderableType:
    """Tables and paths of a finished run; `links` as its tracker answered."""
    paths = path_lines([("run folder", str(folder)), *links])
    return Group(*map(rich_table, result_grids(tables)), paths)


def print_rich(renderable: RenderableType) -> None:
    """Print results to stdout: tables fit the terminal, and no line of text is cut or broken."""
    Console(width=line_width()).print(renderable, soft_wrap=True)
