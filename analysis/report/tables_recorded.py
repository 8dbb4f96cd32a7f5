"""Reads the records of tables in the store, which `sweeps.reproduce` wrote."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.report.data import ShownForm
from analysis.report.store import MlflowRun
from rgbt.checks import InputError
from rgbt.tables import read_csv
from sweeps.verdicts.forms import RELEASED

CSV_FILE = "table.csv"
HEADER = ("table", "row", "column", "mean", "sd", "n", "published", "difference", "reason", "runs")
"""Columns of `CSV_FILE`, which is one line per row and column."""

EXTRA = re.compile(r"Every row of ours was run with (.*)\.")
SHOWN = ("Bold:", "rho:", "Published:", "Ours:", "scale=")
"""Beginnings of remarks that the page shows by itself: marks, data, seeds and scale. Records of
earlier versions have rank correlations ("rho:"), which are not shown any more."""


@dataclass(frozen=True)
class RecordedCell:
    """One cell as it was recorded; None where there was nothing."""

    mean: float | None
    sd: float | None
    seeds: int
    published: float | None
    reason: str
    keys: tuple[str, ...]


NO_CELL = RecordedCell(None, None, 0, None, "", ())


@dataclass(frozen=True, kw_only=True)
class RecordedTable:
    """A table that was run.

    Attributes:
        name: e.g. "spatialseg/table3".
        scale: "demo", "bench" or "paper".
        lines: (row, column) -> cell, in the order of the file.
        remarks: sentences that stood below it.
        extra: overrides that were added to every row, as typed.
        form: what the rows were run as; records of earlier versions have the paper's form.
    """

    name: str
    scale: str
    seeds: tuple[int, ...]
    lines: Mapping[tuple[str, str], RecordedCell]
    remarks: tuple[str, ...] = ()
    extra: str = ""
    form: ShownForm = "paper"

    def rows(self) -> tuple[str, ...]:
        """Labels in order."""
        return tuple(dict.fromkeys(row for row, _ in self.lines))

    def columns(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(dict.fromkeys(column for _, column in self.lines))


def read_recorded(record: MlflowRun) -> RecordedTable:
    """Read the record of a table.

    Raises:
        InputError: its CSV is missing or damaged.
    """
    text = record.files.text(CSV_FILE)
    if text is None:
        raise InputError(
            f"table '{record.name}' has no {CSV_FILE} in the store; rerun its command."
        )
    lines = _lines(text, record.name)
    below = _remarks(record.files.text("table.md") or "")
    extra = [found.group(1) for line in below if (found := EXTRA.fullmatch(line))]
    return RecordedTable(
        name=record.tags.get("rgbt.table", record.name),
        scale=record.tags.get("rgbt.scale", ""),
        seeds=tuple(int(seed) for seed in re.findall(r"\d+", record.tags.get("rgbt.seeds", ""))),
        lines=lines,
        remarks=tuple(below),
        extra=extra[0] if extra else "",
        form=_form(record.tags.get("rgbt.form", "paper"), lines),
    )


def _form(tag: str, lines: Mapping[tuple[str, str], RecordedCell]) -> ShownForm:
    """The form of the rows; with both, a released row follows that of the paper."""
    labels = {row for row, _ in lines}
    if any(row.endswith(RELEASED) and row.removesuffix(RELEASED) in labels for row in labels):
        return "both"
    return "released" if tag == "released" else "paper"


def _remarks(markdown: str) -> list[str]:
    """The remarks of a table, without those of `SHOWN`.

    Tables of the forms and of the claims may follow, with lists of their own: the remarks end where
    another table begins.
    """
    found: list[str] = []
    tables = 0
    for block in markdown.split("\n\n"):
        tables += block.startswith("|")
        if tables > 1:
            break
        found += [line[2:] for line in block.splitlines() if line.startswith("- ")]
    return [line for line in found if not line.startswith(SHOWN)]


def _lines(text: str, name: str) -> dict[tuple[str, str], RecordedCell]:
    header, lines = read_csv(text)
    missing = [column for column in HEADER if column not in header]
    if missing:
        raise InputError(
            f"table '{name}': its {CSV_FILE} lacks the column '{missing[0]}'; rerun its command."
        )
    try:
        return {
            (line["row"], line["column"]): RecordedCell(
                mean=float(line["mean"]) if line["mean"] else None,
                sd=float(line["sd"]) if line["sd"] else None,
                seeds=int(line["n"] or 0),
                published=float(line["published"]) if line["published"] else None,
                reason=line["reason"],
                keys=tuple(line["runs"].split()),
            )
            for line in lines
        }
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"table '{name}': its {CSV_FILE} is damaged ({error}).") from error


def reproduce_command(
    name: str,
    seeds: Sequence[int],
    scale: str,
    extra: str = "",
    *,
    form: ShownForm = "paper",
    until_decided: bool = False,
) -> str:
    """The command that runs what is missing of a table.

    Args:
        name: of the table.
        seeds: 0, 1, 2 is "3"; a single other one needs brackets.
        scale: "demo", "bench" or "paper".
        extra: overrides of every row, as typed.
        form: what the rows are run as.
        until_decided: whether seeds are added to the rows of undecided claims.
    """
    if until_decided:
        text = "until_decided"
    elif tuple(seeds) == tuple(range(len(seeds))):
        text = str(len(seeds))
    else:
        listed = ",".join(map(str, seeds))
        text = listed if len(seeds) > 1 else f"[{listed}]"
    words = [f"table={name}", f"seeds={text}", f"scale={scale}"]
    words += [] if form == "paper" else [f"form={form}"]
    return shlex.join(["rgbt", "reproduce", *words]) + (f" {extra}" if extra else "")
