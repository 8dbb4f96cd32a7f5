"""Rows of a table that are evaluated and not trained: files of weights, folders of predictions.

The command line names them as ``weights.LABEL=FILE`` and ``predictions.LABEL=FOLDER``.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

from rgbt.checks import InputError, nearest
from rgbt.config.compose import available
from rgbt.config.options import with_home
from sweeps.table.row_names import WAYS
from sweeps.table.table import Row, Table

Kind = Literal["weights", "predictions"]
KINDS: tuple[Kind, ...] = get_args(Kind)


@dataclass(frozen=True)
class ExternalRow:
    """A row whose counts are made from a path of the user.

    Attributes:
        label: of the row, as in the table.
        kind: "weights": a file that the row's network is evaluated with; "predictions": a folder of
            predicted label images.
        path: of the file or folder, absolute.
    """

    label: str
    kind: Kind
    path: Path


def external_rows(words: Sequence[str], table: Table) -> tuple[list[ExternalRow], list[str]]:
    """Separate the words about external rows from the overrides.

    A LABEL is that of a row, in upper or lower case. It may omit parentheses ("A" for "(A)") and,
    where one row remains, words after the first ("CMX" or "CMX-B2" for "CMX (MiT-B2)").

    Args:
        words: overrides as typed.
        table: with the rows that are named.

    Returns:
        the external rows in the order of the table, and all other words.

    Raises:
        InputError: no such row or several, a row that is named twice or has no network for
            weights, or a path that does not exist.
    """
    found: dict[str, ExternalRow] = {}
    others = []
    for word in words:
        kind = next((each for each in KINDS if word.startswith(f"{each}.")), None)
        if kind is None:
            others.append(word)
            continue
        row = _external_row(word, kind, table)
        if row.label in found:
            raise InputError(
                f"'{word}': row '{row.label}' already has {found[row.label].kind} "
                f"({found[row.label].path}); remove one of the two."
            )
        found[row.label] = row
    return [found[row.label] for row in table.rows if row.label in found], others


def _external_row(word: str, kind: Kind, table: Table) -> ExternalRow:
    row, text = _named_row(word, kind, table)
    if kind == "weights" and not row.network and row.experiment is None:
        raise InputError(
            f"'{word}': row '{row.label}' has no network that weights can be loaded into; give its "
            f"predictions with {KINDS[1]}.{row.label}=FOLDER."
        )
    path = Path(with_home(text)).absolute()
    is_archive = path.suffix.lower() == ".zip" and path.is_file()
    if not text or not (path.is_file() if kind == "weights" else path.is_dir() or is_archive):
        wanted = "file of weights"
        if kind == "predictions":
            wanted = "folder of predicted label images or a ZIP file of one"
        raise InputError(f"'{word}': '{text}' is not a {wanted}; give the path of one.")
    return ExternalRow(row.label, kind, path)


def _named_row(word: str, kind: Kind, table: Table) -> tuple[Row, str]:
    """The row that a word names, and the text after its label; a label may hold "="."""
    rest = word.removeprefix(f"{kind}.")
    if "=" not in rest:
        example = "FILE" if kind == "weights" else "FOLDER"
        raise InputError(f"'{word}': expected {kind}.LABEL={example}.")
    name, rows = _rows_called(rest, table)
    labels = [row.label for row in table.rows]
    if not rows:
        hint = ""
        if kind == "weights" and name in available("model"):
            hint = f" Initial weights of trained rows are given with pretrained.{name}=FILE."
        raise InputError(f"'{word}': the table has no row '{name}'; {nearest(name, labels)}.{hint}")
    if len(rows) > 1:
        several = ", ".join(f"'{row.label}'" for row in rows)
        raise InputError(f"'{word}': '{name}' may be any of the rows {several}; name one of them.")
    return rows[0], rest[len(name) + 1 :]


def _rows_called(rest: str, table: Table) -> tuple[str, list[Row]]:
    """The name in front of an equals sign of LABEL=PATH, and the rows that it may mean.

    These are the rows that agree with it in the strictest of several ways; [] for none.
    """
    cuts = [match.start() for match in re.finditer("=", rest)]
    for agrees in WAYS:
        for cut in cuts:
            rows = [row for row in table.rows if agrees(rest[:cut], row.label)]
            if rows:
                return rest[:cut], rows
    return rest[: cuts[0]], []
