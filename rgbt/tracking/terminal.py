"""Print messages on stderr, and tables and paths on stdout.

Tables are cut to the width of a terminal: labels are shortened, then columns folded; numbers and
paths are never cut.
"""

from __future__ import annotations

import re
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

from rgbt.tracking.tables import ResultTables, TextTable, result_grids

WIDTH = 10_000
"""Columns where stdout is no terminal: a file takes lines of any length."""

GAP = 3
"""Characters between two columns of a rich table."""

EDGES = 4
"""Characters beside the first and the last column together."""

SHORTEST = 16
"""Characters that a label keeps at least; columns are folded before it gets shorter."""

SHARES = (0.5, 0.75, 0.25, 1.0, 0.0)
"""Parts of what is kept of a label that precede its cut, the preferred one first."""

LETTERS = re.compile(r"[^\W\d]{3,}")
KEYS = re.compile(r"[0-9a-f]{12}( [0-9a-f]{12})*")
"""Keys of runs, which are copied."""

Column = tuple[str, ...]
"""Header and cells of a column."""


def info(sentence: str) -> None:
    """Print a message to stderr."""
    sys.stderr.write(f"rgbt: {sentence}\n")


def warn(sentence: str) -> None:
    """Print a warning to stderr."""
    info(f"warning: {sentence}")


def line_width() -> int:
    """Characters of a line on stdout: of the terminal, or as many as there are in a file."""
    return Console().width if sys.stdout.isatty() else WIDTH


def print_rich(renderable: RenderableType) -> None:
    """Print results to stdout: tables fit the terminal, and no line of text is cut or broken."""
    Console(width=line_width()).print(renderable, soft_wrap=True)


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
            table = Table(box=box.SIMPLE_HEAD)
            for index, (name, *cells) in enumerate(zip(grid.header, *grid.rows, strict=True)):
                side = "left" if index == 0 or any(map(is_text, cells)) else "right"
                table.add_column(escape(name), justify=side, no_wrap=True)  # type: ignore[arg-type]
            for row in grid.rows:
                table.add_row(*map(escape, row))
            yield table
        if self.grid.notes:
            yield Text("\n".join(f" {note}" for note in self.grid.notes), "dim")


def is_text(cell: str) -> bool:
    """Whether a cell is words that may be shortened: no number, interval, key or path.

    Example:
        >>> is_text("stopped after a while"), is_text("+1.20 to +3.40"), is_text("runs/454482 x")
        (True, False, False)
    """
    if not cell[:1].isalpha() or "/" in cell or KEYS.fullmatch(cell):
        return False
    return sum(LETTERS.search(word) is not None for word in cell.split()) > 1


def fitted(grid: TextTable, width: int) -> list[TextTable]:
    """A grid whose lines take at most `width` characters, as one or several below each other.

    Words are shortened first: labels, headers and sentences. Where that is not enough, the last
    columns are folded into a second grid with the same labels.
    """
    room = width - EDGES
    columns = list(zip(grid.header, *grid.rows, strict=True))
    limits = [_width(cells) for cells in columns]
    words = [n for n, cells in enumerate(columns) if n == 0 or any(map(is_text, cells))]
    for index in sorted(words, key=lambda n: -_width(columns[n])):
        over = _taken(_cut_to(columns, limits)) - room
        fixed = [len(cell) for cell in columns[index][1:] if index and not is_text(cell)]
        limits[index] = max(SHORTEST, *fixed, limits[index] - max(over, 0))
    if _taken(_cut_to(columns, limits)) > room:  # folded in any case: no need to cut all
        limits = [max(SHORTEST, room // (2 if index else 3)) for index in range(len(columns))]
    columns = _cut_to(columns, limits)
    found = []
    for number, block in enumerate(blocks(list(map(_width, columns)), room, gap=GAP, first=1)):
        header, *rows = zip(*(columns[index] for index in block), strict=True)
        found.append(TextTable("" if number else grid.title, header, tuple(rows)))
    return found


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


def _taken(columns: Sequence[Column]) -> int:
    return sum(map(_width, columns)) + GAP * (len(columns) - 1)


def _width(cells: Column) -> int:
    return max(map(cell_len, cells))


def shortened(labels: Sequence[str], widths: Sequence[int]) -> tuple[str, ...]:
    """Labels of at most so many characters, cut inside; those that differ still do.

    Cut in the middle, or where that would make two labels equal nearer to an end. Where every cut
    does, a number in its place distinguishes them.

    Args:
        labels: of any length.
        widths: characters of each, >= `SHORTEST`.
    """
    pairs = list(zip(labels, widths, strict=True))
    for share in SHARES:
        cut = tuple(_cut(label, width, "…", share) for label, width in pairs)
        if len(set(cut)) == len(set(labels)):
            return cut
    numbers = {label: str(number) for number, label in enumerate(dict.fromkeys(labels), start=1)}
    return tuple(_cut(label, width, f"…{numbers[label]}…", SHARES[0]) for label, width in pairs)


def _cut(label: str, width: int, middle: str, share: float) -> str:
    if len(label) <= width:
        return label
    kept = width - len(middle)
    head = round(share * kept)
    return label[:head] + middle + label[len(label) - kept + head :]


def blocks(
    widths: Sequence[int], width: int, *, gap: int, first: int, starts: Sequence[int] = ()
) -> list[list[int]]:
    """Columns of each block of a table that is folded to a width.

    Args:
        widths: of the columns, in characters.
        width: of a line.
        gap: characters between two columns.
        first: number of columns that every block begins with: the labels.
        starts: columns that begin a group, which stays in one block where it fits; default: all.

    Returns:
        numbers of columns by block; a block has a column beside the labels, also a too wide one.
    """
    begins = sorted({first, *(starts or range(first, len(widths)))})
    ends = [*begins[1:], len(widths)]
    groups = [list(range(begin, end)) for begin, end in zip(begins, ends, strict=True)]
    labels = list(range(first))

    def taken(columns: Sequence[int]) -> int:
        return sum(widths[column] for column in columns) + gap * (len(columns) - 1)

    found: list[list[int]] = [labels.copy()]
    for group in groups:
        # A group that is wider than a block is folded itself.
        whole = [group] if taken([*labels, *group]) <= width else [[column] for column in group]
        for columns in whole:
            if len(found[-1]) > first and taken([*found[-1], *columns]) > width:
                found.append(labels.copy())
            found[-1] += columns
    return found
