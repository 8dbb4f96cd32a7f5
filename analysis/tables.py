"""Frames as the tables that commands print and write."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable, csv_text, number

if TYPE_CHECKING:  # --help answers without waiting for pandas
    import pandas as pd


def text_table(title: str, frame: pd.DataFrame, notes: Sequence[str] = ()) -> TextTable:
    """A frame as text: its index as labels, then its columns; numbers with two decimals."""
    header = (*(str(name or "") for name in frame.index.names), *map(str, frame.columns))
    rows = (tuple(map(_cell, row)) for row in frame.reset_index().itertuples(index=False))
    return TextTable(title, header, tuple(rows), tuple(notes))


def tidy_csv(frame: pd.DataFrame) -> str:
    """A frame without its index as CSV, eight digits; nothing where a value is missing."""
    cells = frame.astype(object).where(frame.notna(), "")
    rows = ([f"{c:.8g}" if isinstance(c, float) else c for c in row] for row in cells.to_numpy())
    return csv_text([[*frame.columns], *rows])


def _cell(value: Hashable) -> str:
    if isinstance(value, float):
        return number(value)
    return ABSENT if value is None else str(value)
