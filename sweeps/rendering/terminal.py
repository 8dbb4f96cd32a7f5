"""A computed table for the terminal."""

from __future__ import annotations

from collections.abc import Sequence

from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text as RichText

from rgbt.terminal import SHORTEST, plain_text
from sweeps.rendering.rendered_table import WITH_SD, RenderedTable, TextCell

STYLES = ("", "bold", "underline")
SIGNS = ("", "*", "_")
"""By rank: how the best and the second best are shown, with and without styles."""

WIDE = WITH_SD + 2
"""Columns, those of words and seeds counted, above which names are broken into several lines."""

LEGENDS = (
    "Bold: shown to be the best of our rows, underlined: the second best.",
    "*: shown to be the best of our rows, _: the second best.",
)


def terminal(rendered: RenderedTable, *, plain: bool = False) -> RenderableType:
    """The table for `rgbt.terminal.print_rich`: labels are broken where needed, numbers never.

    Args:
        rendered: the table.
        plain: mark the best with signs, where neither bold nor underline would be shown.
    """
    rows = [(line.label, *line.fields) for line in rendered.lines]
    shown = Table(box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False)
    columns: list[list[RichText]] = []
    for index, (name, *cells) in enumerate(zip((TextCell(), *rendered.header), *rows, strict=True)):
        fields = _fields(cells, plain=plain)
        title = f"{name.text}{_bracketed(name)}"
        title = title.replace("_", "\n") if len(rendered.header) > WIDE else title
        width = max(field.cell_len for field in (*fields, *map(RichText, title.split())))
        shown.add_column(
            plain_text(title),
            justify="right" if name.text else "left",
            overflow="fold",
            min_width=width if index else min(width, SHORTEST),
        )
        for field in fields if name.text else ():
            field.align("right", width)  # rich would strip the filling behind a number
            field.justify = "left"
        columns.append(fields)
    for line, row in zip(rendered.lines, zip(*columns, strict=True), strict=True):
        shown.add_row(*row, style="dim" if line.kind in ("sd", "difference") else "")
    below = [f"[{index}] {note}" for index, note in enumerate(rendered.notes, start=1)]
    below += rendered.remarks_with(LEGENDS[plain])
    caption = plain_text(f"{rendered.title.text}{_bracketed(rendered.title)}", "bold")
    return Group(caption, shown, *map(plain_text, below))


def _fields(column: Sequence[TextCell], *, plain: bool) -> list[RichText]:
    """The cells, filled behind their numbers so that these stand below each other."""
    tails = [text.whole.removeprefix(text.text) + _bracketed(text) for text in column]
    width = max(map(len, tails), default=0)
    fields = []
    for text, tail in zip(column, tails, strict=True):
        sign = SIGNS[text.rank] if plain else ""
        # Styled in parts: the filling beside a number is not underlined.
        field = plain_text("").append_text(plain_text(f"{sign}{text.text}", STYLES[text.rank]))
        fields.append(field.append(tail.ljust(width)))
    return fields


def _bracketed(text: TextCell) -> str:
    return "".join(f"[{index}]" for index in text.notes)
