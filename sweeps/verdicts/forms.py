"""Both forms of a table at once: as the paper's text describes it, and as its release made it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from analysis.uncertainty.verdicts import decide
from rgbt.checks import InputError
from rgbt.tables import ABSENT, TextTable
from sweeps.point import Outcome
from sweeps.table.cells import headline_columns, is_counted
from sweeps.table.claim import HIGHER
from sweeps.table.table import Row, Table
from sweeps.verdicts.contrasts import Contrast
from sweeps.verdicts.judge import CellRunId, TableJudge

RELEASED = ", released"
"""Ending of the label of a row in its released form, beside the row of the paper's form."""

WORDS = {"holds": "released is higher", "contradicted": "released is lower"}
HEADER = ("row, column", "released - paper", "95 % interval", "seeds", "shown")
TITLE = "Difference of the forms"


def both_forms(table: Table) -> Table:
    """The table with a further row below each one that the release makes in another way.

    Claims are left out: they are about the rows of one form.

    Raises:
        InputError: no row has a released form of its own.
    """
    rows = [each for row in table.rows for each in _forms_of(row)]
    if len(rows) == len(table.rows):
        raise InputError(
            f"form=both: no row of {table.paper}, {table.number} has a released form of its own; "
            "use form=paper."
        )
    return replace(table, rows=tuple(rows), claims=())


def _forms_of(row: Row) -> Iterator[Row]:
    yield row
    released = row.released
    if released is not None:
        yield replace(
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


def forms_grid(judge: TableJudge, runs: Mapping[CellRunId, Outcome]) -> TextTable | None:
    """One line per row and score: released minus paper, paired by seed, with its interval.

    Returns:
        None where the table has one form.
    """
    scores = list(filter(is_counted, judge.table.columns))
    labels = {row.label for row in judge.table.rows}
    both = [label for label in labels if f"{label}{RELEASED}" in labels]
    rows = [
        _line(judge, Contrast(f"{row.label}{RELEASED}", row.label, column.name), runs)
        for row in judge.table.rows
        if row.label in both
        for column in headline_columns(scores) or scores
    ]
    return TextTable(TITLE, HEADER, tuple(rows)) if rows else None


def _line(
    judge: TableJudge, contrast: Contrast, runs: Mapping[CellRunId, Outcome]
) -> tuple[str, ...]:
    name = f"{contrast.other}, {contrast.column}"
    try:
        found = decide([judge.evidence([(1.0, contrast)], runs)], HIGHER, judge.rule, "all")
    except InputError as error:
        return name, ABSENT, ABSENT, "0", str(error)
    interval = found.interval
    shown = ABSENT if interval is None else f"[{interval.low:+.2f}, {interval.high:+.2f}]"
    word = WORDS.get(found.kind, "not shown")
    return name, f"{found.estimate:+.2f}", shown, str(found.seeds), word
