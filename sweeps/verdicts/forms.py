"""Both forms of a table at once: as the paper's text describes it, and as its release made it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from analysis.uncertainty.verdicts import decide
from rgbt.checks import InputError
from rgbt.tables import ABSENT, TextTable
from sweeps.point import Outcome
from sweeps.table.cells import headline_columns, is_counted
from sweeps.table.claim import HIGHER
from sweeps.table.table import Row, Table
from sweeps.verdicts.judge import CellRunId, Contrast, TableJudge

RELEASED = ", released"
"""Ending of the label of a row in its released form, beside the row of the paper's form."""

WORDS = {"holds": "released is higher", "contradicted": "released is lower"}
HEADER = ("row, column", "released - paper", "95 % interval", "seeds", "shown")


def both_forms(table: Table) -> Table:
    """The table with a further row below each one that the release makes in another way.

    Claims are left out: they are about the rows of one form.

    Raises:
        InputError: no row has a released form of its own.
    """
    rows: list[Row] = []
    for row in table.rows:
        released = row.released
        rows.append(row)
        if released is not None:
            other = replace(
                row,
                label=f"{row.label}{RELEASED}",
                experiment=released.experiment or row.experiment,
                overrides=row.overrides if released.overrides is None else released.overrides,
                at=row.at if released.at is None else released.at,
                released=None,
                same_as=row.label,
                x=None,
                remarks=released.remarks,
                doubtful=(),
            )
            rows.append(other)
    if len(rows) == len(table.rows):
        raise InputError(
            f"form=both: no row of {table.paper}, {table.number} has a released form of its own; "
            "use form=paper."
        )
    return replace(table, rows=tuple(rows), claims=())


def forms_grid(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> TextTable | None:
    """One line per row and score: released minus paper, paired by seed; None of one form."""
    scores = list(filter(is_counted, judge.table.columns))
    labels = {row.label for row in judge.table.rows}
    rows = []
    for label in (row.label for row in judge.table.rows if f"{row.label}{RELEASED}" in labels):
        for column in headline_columns(scores) or scores:
            name = f"{label}, {column.name}"
            contrast = Contrast(f"{label}{RELEASED}", label, column.name)
            try:
                evidence = judge.evidence([(1.0, contrast)], runs)
            except InputError as error:
                rows.append((name, ABSENT, ABSENT, "0", str(error)))
                continue
            found = decide([evidence], HIGHER, judge.rule, "all")
            around = found.interval
            shown = ABSENT if around is None else f"[{around.low:+.2f}, {around.high:+.2f}]"
            word = WORDS.get(found.kind, "not shown")
            rows.append((name, f"{found.estimate:+.2f}", shown, str(found.seeds), word))
    return TextTable("Difference of the forms", HEADER, tuple(rows)) if rows else None
