"""Write CSV files in which a spreadsheet treats no text as a formula.

A label such as ``=HYPERLINK(...)`` would be executed there. Such cells get a leading apostrophe,
which spreadsheets read as "this is text"; reading removes it.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Sequence
from typing import Any

from rgbt.checks import InputError

FORMULA = re.compile(r"'*[=+\-@\t\r\n]")
"""Beginning of a cell that gets an apostrophe; also of one that would look as if it had got one."""


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Rows, header first, as the text of a CSV file."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerows([_as_text(cell) for cell in row] for row in rows)
    return stream.getvalue()


def read_csv(text: str) -> tuple[list[str], list[dict[str, Any]]]:
    """Header and lines of what `csv_text` wrote, cells as they were given to it, as text.

    Raises:
        InputError: it is not CSV.
    """
    reader = csv.DictReader(io.StringIO(text))
    try:
        header = [_original(name) for name in reader.fieldnames or ()]
        reader.fieldnames = header
        lines = [{name: _original(cell) for name, cell in line.items()} for line in reader]
    except csv.Error as error:
        raise InputError(f"a CSV file of the store is damaged: {error}.") from error
    return header, lines


def _as_text(cell: object) -> object:
    if not isinstance(cell, str):
        return cell
    text = cell.replace("\r", "\n")  # the writer does not quote a carriage return
    if not FORMULA.match(text):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def _original(cell: Any) -> Any:
    is_marked = isinstance(cell, str) and cell.startswith("'") and FORMULA.match(cell) is not None
    return cell[1:] if is_marked else cell
