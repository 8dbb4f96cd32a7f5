"""A computed table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from rich.text import Text as RichText

from rgbt.tracking.terminal import SHORTEST, WIDTH, blocks, shortened
from sweeps.rendering.rendered_table import BESIDE_OURS, WITH_SD, RenderedTable, TextCell

STYLES = ("", "bold", "underline")
SIGNS = ("", "*", "_")
"""By rank: how the best and the second best are shown, with and without styles."""

GAP = 2
"""Spaces between two columns in the terminal."""

WIDE = WITH_SD + 2
"""Columns, those of words and seeds counted, above which names are broken into several lines."""

LEGENDS = (
    "Bold: shown to be the best of our rows, underlined: the second best.",
    "*: shown to be the best of our rows, _: the second best.",
)


def terminal(rendered: RenderedTable, *, plain: bool = False, width: int = WIDTH) -> RichText:
    """The table for `rgbt.tracking.terminal.print_rich`.

    Args:
        rendered: the table.
        plain: mark the best with signs, where neither bold nor underline would be shown.
        width: of a line; labels are shortened and columns folded to it, numbers never cut.
    """
    header = [(TextCell(), *line) for line in _stacked(rendered.header)]
    rows = [*header, *((line.label, *line.fields) for line in rendered.lines)]
    fields = _fields(rows, plain=plain)
    if sum(_widths(fields)) + GAP * (len(fields[0]) - 1) > width:
        limits = [max(SHORTEST, width // 3)] * len(rows)
        labels = shortened([row[0].text for row in rows], limits)
        named = zip(rows, labels, strict=True)
        short = [(replace(row[0], text=label), *row[1:]) for row, label in named]
        fields = _fields(short, plain=plain)
    widths = _widths(fields)
    # The labels: of the row, of the line where a row has several, and the number of seeds.
    first = 2 if any(line.kind == "all" for line in rendered.lines) else 3
    starts = [n for n, text in enumerate(header[-1]) if n >= first and text.text not in BESIDE_OURS]
    shown: list[RichText] = []
    for part in blocks(widths, width, gap=GAP, first=first, starts=starts):
        shown += [RichText()] if shown else []
        shown += _block(rendered, [[row[n].copy() for n in part] for row in fields])
    title = RichText(f"{rendered.title.text}{_bracketed(rendered.title)}", "bold")
    below = [f"[{index}] {note}" for index, note in enumerate(rendered.notes, start=1)]
    below += rendered.remarks_with(LEGENDS[plain])
    return RichText("\n").join([title, *shown, *map(RichText, below)])


def _fields(rows: Sequence[Sequence[TextCell]], *, plain: bool) -> list[list[RichText]]:
    """The cells, filled behind their numbers so that these stand below each other."""
    columns: list[list[RichText]] = []
    for column in zip(*rows, strict=True):
        tails = [text.whole.removeprefix(text.text) + _bracketed(text) for text in column]
        width = max(map(len, tails))
        columns.append([])
        for text, tail in zip(column, tails, strict=True):
            sign = SIGNS[text.rank] if plain else ""
            # Styled in parts: the padding beside a number is not underlined.
            field = RichText().append(f"{sign}{text.text}", STYLES[text.rank])
            columns[-1].append(field.append(tail.ljust(width)))
    return [list(row) for row in zip(*columns, strict=True)]


def _widths(fields: Sequence[Sequence[RichText]]) -> list[int]:
    return [max(field.cell_len for field in column) for column in zip(*fields, strict=True)]


def _block(rendered: RenderedTable, fields: Sequence[Sequence[RichText]]) -> list[RichText]:
    """Header and lines of some columns, between rules."""
    widths, height = _widths(fields), len(fields) - len(rendered.lines)
    numeric = [
        any(text.plain.strip() for text in column) for column in zip(*fields[:height], strict=True)
    ]
    lines = [_aligned(row, widths, numeric) for row in fields]
    for line, row in zip(rendered.lines, lines[height:], strict=True):
        row.stylize("dim" if line.kind in ("sd", "difference") else "")
    rule = RichText("─" * (sum(widths) + GAP * (len(widths) - 1)))
    return [*lines[:height], rule, *lines[height:], rule]


def _stacked(header: Sequence[TextCell]) -> list[tuple[TextCell, ...]]:
    """The header in one line; of a wide table in several, names broken at underscores."""
    if len(header) <= WIDE:
        return [tuple(header)]
    broken = [text.text.split("_") for text in header]
    height = max(map(len, broken))
    lines = []
    for above in reversed(range(height)):
        words = [parts[-1 - above] if above < len(parts) else "" for parts in broken]
        notes = [text.notes if above == 0 else () for text in header]
        lines.append(tuple(TextCell(w, notes=n) for w, n in zip(words, notes, strict=True)))
    return lines


def _aligned(row: Sequence[RichText], widths: Sequence[int], numeric: Sequence[bool]) -> RichText:
    """One line: numbers to the right, words to the left."""
    line = RichText()
    for index, (text, width, right) in enumerate(zip(row, widths, numeric, strict=True)):
        text.align("right" if right else "left", width)
        line.append(" " * GAP if index else "").append_text(text)
    line.rstrip()
    return line


def _bracketed(text: TextCell) -> str:
    return "".join(f"[{index}]" for index in text.notes)
