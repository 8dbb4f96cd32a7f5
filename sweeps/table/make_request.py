"""Makes the request of a table from the words of a command, and checks its rows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from rgbt.checks import InputError, check_choice, nearest, split_list
from rgbt.config.compose import available
from sweeps.table.cells import is_counted, metric_of
from sweeps.table.claim import PREVIOUS
from sweeps.table.external import ExternalRow, external_rows, row_named
from sweeps.table.load_table import PUBLISHED, STUDIES, load_table, table_names, table_path
from sweeps.table.request import PRETRAINED, TableRequest
from sweeps.table.table import Form, Row, Table
from sweeps.worker.planner import Planner

OF_THE_ROWS = {
    "seed": "the rows set it; choose seeds=3.",
    "experiment": "the rows set it; choose another table.",
    "metric": "the columns define what is counted; set `regions` in your own table.",
    "consistency": "the columns define what is counted; see rgbt consistency run=...",
}
"""Nodes of the configuration that no override may change."""


def read_named(name: str) -> tuple[str, Table]:
    """A table with the name that its records get; InputError: as of `load_table`, or the name."""
    table, path = load_table(name), table_path(name).resolve()
    if name.endswith((".yaml", ".yml")):
        folder = PUBLISHED if path.is_relative_to(PUBLISHED) else STUDIES
        inside = path.is_relative_to(folder)
        stem = path.relative_to(folder).with_suffix("") if inside else f"{table.paper}/{path.stem}"
        name = str(stem)
        if not inside and name in table_names(Path("none")):
            raise InputError(f"table={path}: '{name}' is a published table; change `paper`.")
    if not re.fullmatch(r"[\w\-. :/]+", name, re.ASCII):
        raise InputError(f"table={name}: MLflow allows only letters, digits, spaces and _-.:/")
    return name, table


def check_override(word: str) -> None:
    """Refuse an override that belongs to the rows or columns of a table."""
    key = word.lstrip("+~").partition("=")[0].rpartition("@")[2].partition(".")[0]
    if key in OF_THE_ROWS:
        raise InputError(f"'{word}': {OF_THE_ROWS[key]}")


def select_rows(table: Table, text: str) -> Table:
    """The table with the rows of ``rows=A,H`` alone, and with the claims about them.

    A row is named by its label or its number, several by the name of their group (`Row.group`).
    """
    labels, words = [row.label for row in table.rows], split_list(text, "rows")
    chosen: set[str] = set()
    while words:  # a label may contain commas
        ends = range(len(words), 1, -1)
        end = next((each for each in ends if ", ".join(words[:each]) in labels), 1)
        word = ", ".join(words[:end])
        group = {row.label for row in table.rows if row.group == word}
        chosen |= group or {row_named(word, table).label}
        del words[:end]
    first, origin, rows = dict[str, str](), _origins(table), list[Row]()
    for row in table.rows:
        if row.label in chosen:
            same = first.setdefault(origin[row.label], row.label)
            rows.append(replace(row, same_as=None if same == row.label else same))

    # "Better than all others" is another statement where some of the others are missing.
    claims = table.claims
    if len(rows) < len(table.rows):
        known = {*chosen, PREVIOUS}
        claims = tuple(each for each in claims if {*each.rows, *each.against} <= known)
    return replace(table, rows=tuple(rows), claims=claims)


def check_equal_runs(request: TableRequest, planner: Planner) -> None:
    """Refuse rows that are one run with the same scores, unless the table says so (`same_as`).

    Rows that cannot be composed are left to the planning.
    """
    origin = _origins(request.table)
    seen: dict[tuple[Any, ...], str] = {}
    for row in request.trained_rows:
        try:
            spec = planner.specify((*planner.base, *request.overrides(row.label, 0)))
        except InputError:
            continue
        metrics = [metric_of(each, row) for each in request.table.columns if is_counted(each)]
        same = seen.setdefault((spec.key, *metrics), row.label)
        if origin[same] != origin[row.label]:
            raise InputError(
                f"the rows '{same}' and '{row.label}' of {request.name} would be the same run "
                f"({spec.key}) at scale={request.scale}, form={request.form}; remove the override "
                f"that makes them equal, or write same_as: {same} in the table."
            )


def _origins(table: Table) -> dict[str, str]:
    """Label of every row -> the first of the rows that may be the same run."""
    origin: dict[str, str] = {}
    for row in table.rows:
        origin[row.label] = origin.get(row.same_as or "", row.label)
    return origin


@dataclass(frozen=True, kw_only=True)
class TableWords:
    """What a command says about a table, see `sweeps.table.request.TableRequest`.

    `overrides` are those of every row, with pretrained.NETWORK=FILE, weights.ROW=FILE and
    predictions.ROW=FOLDER; `others` are further words that make it another table.
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
    """The request of a table, and its rows that are evaluated and not trained."""
    check_choice("scale", words.scale, available("scale"))
    table = select_rows(table, words.rows) if words.rows else table
    external, others = external_rows(words.overrides, table)
    files = [word.removeprefix(PRETRAINED) for word in others if word.startswith(PRETRAINED)]
    rows = [f"rows={words.rows}"] if words.rows else []
    paths = [f"{row.kind}.{row.label}={row.path}" for row in external]
    request = TableRequest(
        name,
        table,
        words.scale,
        tuple(words.seeds),
        tuple(word for word in others if not word.startswith(PRETRAINED)),
        pretrained={word.partition("=")[0]: word.partition("=")[2] for word in files},
        form=words.form,
        until_decided=words.until_decided,
        evaluated=tuple(row.label for row in external),
        typed=(*words.others, *rows, *paths),
    )
    for model in request.pretrained:
        if model not in request.models():
            raise InputError(
                f"{PRETRAINED}{model}: no row of {name} uses that network at "
                f"scale={words.scale}; {nearest(model, request.models())}."
            )
    return request, external
