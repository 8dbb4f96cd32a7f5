"""Makes the request of a table from the words of a command."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from rgbt.checks import InputError, check_choice, nearest
from rgbt.config.compose import available
from sweeps.table.external import ExternalRow, external_rows
from sweeps.table.load_table import PUBLISHED, STUDIES, load_table, table_names
from sweeps.table.request import PRETRAINED, TableRequest
from sweeps.table.rows import select_rows
from sweeps.table.scoring import check_metrics
from sweeps.table.table import Form, Table
from sweeps.worker.storage import NAME


def read_named(name: str) -> tuple[str, Table]:
    """A table with the name that its records get.

    Raises:
        InputError: no such table, a metric that does not exist, or a name that MLflow refuses.
    """
    table = load_table(name)
    if name.endswith((".yaml", ".yml")):
        path, name = Path(name).expanduser(), f"{table.paper}/{Path(name).stem}"
        if path.resolve().parent == STUDIES:
            name = path.stem
        if name in table_names(PUBLISHED / "none") and not path.resolve().is_relative_to(PUBLISHED):
            raise InputError(
                f"table={path}: '{name}' is a published table, whose records it would replace; "
                "change `paper` in the file, or its name."
            )
    check_metrics(table)
    if not re.fullmatch(NAME, name):
        raise InputError(
            f"table={name}: MLflow allows only letters, digits, spaces and _ - . : / alone; "
            "rename the file."
        )
    return name, table


def check_override(word: str) -> None:
    """Refuse an override that belongs to the rows or columns of a table.

    Raises:
        InputError: in one sentence, with what to do instead.
    """
    key = word.lstrip("+~").partition("=")[0]
    if key in ("seed", "experiment"):
        other = "seeds=3" if key == "seed" else "another table"
        raise InputError(f"'{word}' is set by the rows of the table; choose {other}.")
    if key.rpartition("@")[2].partition(".")[0] == "consistency":
        raise InputError(
            f"'{word}': the columns of the table define what is counted, on the published sets "
            "of views; measure others with rgbt consistency run=..."
        )
    if key == "metric" or key.startswith("metric."):
        raise InputError(
            f"'{word}': the columns of the table define what is counted; set `regions` in your "
            "own table."
        )


@dataclass(frozen=True, kw_only=True)
class TableWords:
    """What a command says about a table.

    Attributes:
        seeds: of every row.
        scale: a file of ``conf/scale``.
        form: what the rows are run as.
        rows: the rows to keep, with commas; "": all.
        overrides: of every row, with pretrained.NETWORK=FILE, weights.ROW=FILE and
            predictions.ROW=FOLDER.
        others: further words that make it another table.
        until_decided: see `sweeps.table.request.TableRequest`.
    """

    seeds: Sequence[int]
    scale: str
    form: Form = "paper"
    rows: str = ""
    overrides: Sequence[str] = ()
    others: Sequence[str] = ()
    until_decided: bool = False


def make_request(
    name: str, table: Table, words: TableWords
) -> tuple[TableRequest, list[ExternalRow]]:
    """The request of a table, and its rows that are evaluated and not trained.

    Args:
        name: of the table.
        table: its file, see `read_named`.
        words: of the command.

    Raises:
        InputError: no such scale, row or network.
    """
    rows, scale = words.rows, words.scale
    check_choice("scale", scale, available("scale"))
    table = select_rows(table, rows) if rows else table
    external, others = external_rows(words.overrides, table)
    files = [word.removeprefix(PRETRAINED) for word in others if word.startswith(PRETRAINED)]
    pretrained = {word.partition("=")[0]: word.partition("=")[2] for word in files}
    request = TableRequest(
        name,
        table,
        scale,
        tuple(words.seeds),
        tuple(word for word in others if not word.startswith(PRETRAINED)),
        pretrained,
        form=words.form,
        until_decided=words.until_decided,
        evaluated=tuple(row.label for row in external),
        typed=(*words.others, *([f"rows={rows}"] if rows else []), *map(_word, external)),
    )
    for model in pretrained:
        if model not in request.models():
            raise InputError(
                f"{PRETRAINED}{model}: no row of {name} uses that network at "
                f"scale={scale}; {nearest(model, request.models())}."
            )
    return request, external


def _word(row: ExternalRow) -> str:
    return f"{row.kind}.{row.label}={row.path}"
