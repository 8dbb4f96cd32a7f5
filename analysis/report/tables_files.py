"""Records of tables in the store: what `sweeps.reproduce` wrote when it finished one."""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from analysis.report.store import MlflowRun
from rgbt.checks import InputError
from rgbt.tracking.csv_files import read_csv

CSV_FILE = "table.csv"
HEADER = ("table", "row", "column", "mean", "sd", "n", "published", "difference", "reason", "runs")
"""Columns of `CSV_FILE`, which is one line per row and column."""

MARKDOWN_FILE = "table.md"
EXTRA = re.compile(r"Every row of ours was run with (.*)\.")
SHOWN = ("Bold:", "rho:", "Published:", "Ours:", "scale=demo:")
"""Beginnings of remarks that the page shows by itself: marks, data, seeds and scale."""

DEFAULT_SEEDS = (0, 1, 2)
"""Of a table that nobody has run yet."""


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
        scale: "demo" or "paper".
        lines: (row, column) -> cell, in the order of the file.
        remarks: sentences that stood below it.
        extra: overrides that were added to every row, as typed.
        orders: column -> rank correlation as MLflow has it.
    """

    name: str
    scale: str
    seeds: tuple[int, ...]
    lines: Mapping[tuple[str, str], RecordedCell]
    remarks: tuple[str, ...] = ()
    extra: str = ""
    orders: Mapping[str, float]

    def rows(self) -> tuple[str, ...]:
        """Labels in order."""
        return tuple(dict.fromkeys(row for row, _ in self.lines))

    def columns(self) -> tuple[str, ...]:
        """Names in order."""
        return tuple(dict.fromkeys(column for _, column in self.lines))

    def keys_of(self, row: str) -> tuple[str, ...]:
        """Keys of the runs of a row."""
        keys = [key for (label, _), line in self.lines.items() if label == row for key in line.keys]
        return tuple(dict.fromkeys(keys))


def read_recorded(record: MlflowRun) -> RecordedTable:
    """Read the record of a table.

    Raises:
        InputError: its CSV is missing or damaged.
    """
    text = record.files.text(CSV_FILE)
    if text is None:
        raise InputError(f"table '{record.name}' has no {CSV_FILE} in the store; run it again.")
    below = _remarks(record.files.text(MARKDOWN_FILE) or "")
    extra = [found.group(1) for line in below if (found := EXTRA.fullmatch(line))]
    orders = {n.removeprefix("order/"): v for n, v in record.metrics.items() if "order/" in n}
    return RecordedTable(
        name=record.tags.get("rgbt.table", record.name),
        scale=record.tags.get("rgbt.scale", ""),
        seeds=tuple(int(seed) for seed in re.findall(r"\d+", record.tags.get("rgbt.seeds", ""))),
        lines=_lines(text, record.name),
        remarks=tuple(below),
        extra=extra[0] if extra else "",
        orders=orders,
    )


def _lines(text: str, name: str) -> dict[tuple[str, str], RecordedCell]:
    header, lines = read_csv(text)
    missing = [column for column in HEADER if column not in header]
    if missing:
        raise InputError(
            f"table '{name}': its {CSV_FILE} lacks the column '{missing[0]}'; run it again."
        )
    try:
        return {(line["row"], line["column"]): _line(line) for line in lines}
    except (ValueError, TypeError, AttributeError) as error:
        raise InputError(f"table '{name}': its {CSV_FILE} is damaged ({error}).") from error


def _line(line: Mapping[str, str]) -> RecordedCell:
    def number(column: str) -> float | None:
        return float(line[column]) if line[column] else None

    return RecordedCell(
        mean=number("mean"),
        sd=number("sd"),
        seeds=int(line["n"] or 0),
        published=number("published"),
        reason=line["reason"],
        keys=tuple(line["runs"].split()),
    )


def _remarks(markdown: str) -> list[str]:
    """The list below the table; without `SHOWN`."""
    lines = [line[2:] for line in markdown.splitlines() if line.startswith("- ")]
    return [line for line in lines if not line.startswith(SHOWN)]


def reproduce_command(name: str, seeds: Sequence[int], scale: str, extra: str = "") -> str:
    """The command that runs what is missing of a table.

    Args:
        name: of the table.
        seeds: 0, 1, 2 is "3"; a single other one needs brackets.
        scale: "demo" or "paper".
        extra: overrides of every row, as typed.
    """
    if tuple(seeds) == tuple(range(len(seeds))):
        text = str(len(seeds))
    else:
        listed = ",".join(map(str, seeds))
        text = listed if len(seeds) > 1 else f"[{listed}]"
    words = [f"table={name}", f"seeds={text}", f"scale={scale}"]
    return shlex.join(["rgbt", "reproduce", *words]) + (f" {extra}" if extra else "")
