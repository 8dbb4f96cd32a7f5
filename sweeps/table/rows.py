"""Rows of a request: the selected ones, and the refusal of overrides that mix rows up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any

from rgbt.checks import InputError, split_list
from rgbt.runs.run_spec import NOT_IN_KEY, WEIGHTS, RunSpec
from sweeps.table.cells import is_counted, metric_of
from sweeps.table.claim import OTHERS, PREVIOUS
from sweeps.table.request import TableRequest
from sweeps.table.row_names import find_label
from sweeps.table.table import Row, Table
from sweeps.worker.planner import Planner

SUBJECTS = ("dataset", "domains", "transform", "masker", "model", "loss", "scheme")
"""Nodes of the configuration that a row can be about. The others say how long and on what it is
run, which a user may change for all rows: recipe, trainer, optimizer, schedule."""


def select_rows(table: Table, text: str) -> Table:
    """The table with the rows of ``rows=A,H`` alone, and with the claims about them.

    A group of rows (`Row.group`) is chosen by its name.

    Raises:
        InputError: a name that no row has, or several.
    """
    chosen = _chosen(table, text)
    by_label = {row.label: row for row in table.rows}
    first: dict[str, str] = {}
    rows: list[Row] = []
    for row in table.rows:
        if row.label in chosen:
            *_, root = (row.label, *_chain(by_label, row.label))
            same = first.setdefault(root, row.label)
            rows.append(replace(row, same_as=None if same == row.label else same))

    def is_left(names: Sequence[str]) -> bool:
        return names == (PREVIOUS,) or set(names) <= chosen

    # "Better than all others" is another statement where some of the others are missing.
    claims = [each for each in table.claims if is_left(each.rows) and is_left(each.against)]
    complete = len(rows) == len(table.rows)
    kept = tuple(table.claims if complete else claims)
    assert all(OTHERS not in each.against for each in kept) or complete
    return replace(table, rows=tuple(rows), claims=kept)


def _chosen(table: Table, text: str) -> set[str]:
    """Labels of the rows of ``rows=A,H``; the name of a group stands for its rows."""
    groups: dict[str, set[str]] = {}
    for row in table.rows:
        if row.group:
            groups.setdefault(row.group, set()).add(row.label)
    labels = [row.label for row in table.rows]
    chosen: set[str] = set()
    for word in _listed(text, labels):
        chosen |= groups.get(word) or {find_label(word, labels, "rows=")}
    return chosen


def _listed(text: str, labels: Sequence[str]) -> Iterator[str]:
    """The parts of a list with commas; a label that has commas itself is one part."""
    parts = split_list(text, "rows")
    while parts:
        ends = range(len(parts), 0, -1)
        joined = [(end, ", ".join(parts[:end])) for end in ends]
        end, word = next((each for each in joined if each[1] in labels), (1, parts[0]))
        yield word
        parts = parts[end:]


def check_rows(request: TableRequest, planner: Planner) -> None:
    """Refuse overrides that change what rows are about, and rows that are the same run unawares.

    Args:
        request: the table.
        planner: of its runs.

    Raises:
        InputError: in one sentence, with the rows.
    """
    _check_clashes(request, planner)
    _check_equal_runs(request, planner)


def _check_clashes(request: TableRequest, planner: Planner) -> None:
    words = [word for word in request.extra if _key(word).partition(".")[0] in SUBJECTS]
    if not words:
        return
    as_published = replace(request, extra=(), pretrained={})
    for (first, a), (second, b) in combinations(_specified(as_published, planner), 2):
        varied = _varied(a, b)
        for word in words:
            key = _key(word)
            if any(_is_inside(each, key) or _is_inside(key, each) for each in varied):
                raise InputError(
                    f"'{word}' would replace what the rows '{first}' and '{second}' of "
                    f"{request.name} differ in; choose the rows that it is for with rows=..."
                )


def _check_equal_runs(request: TableRequest, planner: Planner) -> None:
    """Rows with the same metrics have runs of their own, unless the table says otherwise."""
    rows = {row.label: row for row in request.table.rows}
    seen: dict[tuple[Any, ...], str] = {}
    for label, spec in _specified(request, planner):
        row = rows[label]
        metrics = [metric_of(each, row) for each in request.table.columns if is_counted(each)]
        same = seen.setdefault((spec.key, *metrics), label)
        if same != label and not _are_declared(rows, same, label):
            raise InputError(
                f"the rows '{same}' and '{label}' of {request.name} would be the same run "
                f"({spec.key}) at scale={request.scale}, form={request.form}; remove the override "
                f"that makes them equal, or write same_as: {same} in the table."
            )


def _are_declared(rows: Mapping[str, Row], first: str, second: str) -> bool:
    """Whether `second` names `first` with `same_as`, directly or by a row between."""
    return first in _chain(rows, second) or bool(
        set(_chain(rows, second)) & set(_chain(rows, first))
    )


def _chain(rows: Mapping[str, Row], label: str) -> Iterator[str]:
    row = rows.get(label)
    while row is not None and row.same_as is not None:
        yield row.same_as
        row = rows.get(row.same_as)


def _specified(request: TableRequest, planner: Planner) -> Iterator[tuple[str, RunSpec]]:
    """The trained rows with their specifications; those that cannot be composed fail later."""
    for row in request.trained_rows:
        try:
            overrides = (*planner.base, *request.overrides(row.label, 0))
            yield row.label, planner.specify(overrides)
        except InputError:
            continue


def _varied(a: RunSpec, b: RunSpec) -> set[str]:
    """Dotted keys of `SUBJECTS` in which two runs differ; paths and initial weights aside."""
    first, second = (dict(_flat({name: each.plain[name] for name in SUBJECTS})) for each in (a, b))
    nothing = object()
    keys = {*first, *second}
    return {
        key
        for key in keys
        if first.get(key, nothing) != second.get(key, nothing)
        and key != WEIGHTS
        and not any(_is_inside(key, out) for out in NOT_IN_KEY)
    }


def _flat(plain: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for key, each in plain.items():
        if isinstance(each, Mapping):
            yield from _flat(each, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", each


def _key(word: str) -> str:
    """The dotted key of an override: "+model/inputs@model=x" is "model.inputs"."""
    return word.lstrip("+~").partition("=")[0].partition("@")[0].replace("/", ".")


def _is_inside(key: str, other: str) -> bool:
    return key == other or key.startswith(f"{other}.")
