"""The tables of a result as data, as grids of text, and as CSV.

Nothing is computed here but percentages and the mean of day and night; the scores come from
`rgbt.metrics.scores`.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Annotated, Any

from pydantic import BeforeValidator, TypeAdapter

from rgbt.checks import without_controls
from rgbt.metrics.names import DAY, NIGHT

# Text of an undefined score, e.g. the IoU of a class that occurs nowhere.
ABSENT = "-"

# Cells of text: words, and names longer than a key or a number.
LABEL = re.compile(r"[^\W\d_]{3}.* |.{32}")

# Beginning of a cell that a spreadsheet may execute, also behind apostrophes.
FORMULA = re.compile(r"'*[=+\-@\t\r\n]")

# A fraction; NaN, where undefined, is None in files.
Score = Annotated[float, BeforeValidator(lambda value: math.nan if value is None else value)]


@dataclass(frozen=True)
class RegionTable:
    """One row of a per-region table, as the papers print it."""

    row_label: str  # method, e.g. "grbm (ours, seed 0)"
    region_ious: tuple[Score, ...]  # R mean IoUs, region 1 first
    miou: Score  # whole image: pooled over regions
    variance: Score  # population variance over regions, squared percent points


@dataclass(frozen=True)
class ClassTable:
    """Scores of K classes; NaN where a class is absent."""

    names: tuple[str, ...]
    ious: tuple[Score, ...]  # over the whole image
    accuracies: tuple[Score, ...]  # recall
    region_ious: tuple[tuple[Score, ...], ...]  # K rows of R
    subset_mious: Mapping[str, Score]  # subsets of the images: {"day": 0.41, "night": 0.38}
    unscored: tuple[str, ...] = ()  # classes that are left out of every mean
    notes: tuple[str, ...] = ()  # about absent classes (`rgbt.metrics.scores.absent_notes`)


@dataclass(frozen=True)
class ConsistencyTable:
    """Agreement of the predictions of two frames for K classes; NaN without pixels.

    Mappings are by protocol: "aligned", "released" or "next".
    """

    names: tuple[str, ...]
    tc: Mapping[str, tuple[Score, ...]]  # temporal consistency
    ca: Mapping[str, tuple[Score, ...]]  # consistent accuracy
    mean_tc: Mapping[str, Score]
    mean_ca: Mapping[str, Score]
    unscored: tuple[str, ...] = ()  # classes that are left out of the means
    notes: tuple[str, ...] = ()  # how classes without a pixel count


@dataclass(frozen=True)
class ResultTables:
    """All tables of one evaluation of the split "val" or "test"."""

    split: str
    step: int
    region_names: tuple[str, ...]  # e.g. "ring_1", the innermost ring
    regions: RegionTable
    classes: ClassTable
    consistency: ConsistencyTable | None = None  # where the run measured it

    def to_json(self) -> dict[str, Any]:
        """Return plain values; NaN becomes None."""
        return dict(without_nan(asdict(self)))

    @classmethod
    def from_json(cls, plain: Mapping[str, Any]) -> ResultTables:
        """Invert `to_json`; raises pydantic's ValidationError, a ValueError."""
        return TypeAdapter(cls).validate_python(plain)


@dataclass(frozen=True)
class TextTable:
    """A table of text: first column labels, the others numbers; footnotes."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def to_markdown(self) -> str:
        """Write the table in Markdown, with the title in bold above it and its footnotes below.

        Control characters and new lines of names become "?".
        """
        columns = list(zip(*self.rows, strict=True)) or [()] * len(self.header)
        rule = []
        for number, column in enumerate(columns):
            is_text = number == 0 or any(map(LABEL.match, column))
            rule.append("---" if is_text else "---:")
        rows = ([cell.replace("|", "\\|") for cell in row] for row in self.rows)
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, rule, *rows)]
        title = [f"**{self.title}**", ""] if self.title else []
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        every = [*title, *lines, *notes]
        return "\n".join(without_controls(line.replace("\n", "?")) for line in every) + "\n"


def class_grid(tables: ResultTables) -> TextTable:
    """Make the table of IoU and accuracy by class in the image, then IoU by region; percent."""
    classes, regions = tables.classes, tables.regions
    labels = class_labels(classes.names, classes.unscored)
    scores = zip(classes.ious, classes.accuracies, classes.region_ious, strict=True)
    rows = [
        (label, *map(percent, (iou, accuracy, *by_region)))
        for label, (iou, accuracy, by_region) in zip(labels, scores, strict=True)
    ]
    mean = ("mean", percent(regions.miou), "", *map(percent, regions.region_ious))
    header = ("class", "IoU", "Acc", *tables.region_names)
    return TextTable("IoU and accuracy by class", header, (*rows, mean), classes.notes)


def subset_mious(classes: ClassTable) -> dict[str, float]:
    """Return the mean IoU of subsets, and the mean of day and night, which the thesis prints.

    It is not the mIoU of all images, of which the pixels are pooled.
    """
    found = dict(classes.subset_mious)
    if {DAY, NIGHT} <= found.keys():
        found["mean of day and night"] = (found[DAY] + found[NIGHT]) / 2
    return found


def consistency_grid(table: ConsistencyTable, title: str) -> TextTable:
    """Make the table of TC and CA by class, one pair of columns per protocol; percent."""
    header, columns = ["class"], []
    for protocol in table.tc:
        header += [f"TC {protocol}", f"CA {protocol}"]
        columns.append((*table.tc[protocol], table.mean_tc[protocol]))
        columns.append((*table.ca[protocol], table.mean_ca[protocol]))
    labels = (*class_labels(table.names, table.unscored), "mean")
    rows = [(name, *map(percent, row)) for name, *row in zip(labels, *columns, strict=True)]
    return TextTable(title, tuple(header), tuple(rows), table.notes)


def result_grids(tables: ResultTables) -> tuple[TextTable, ...]:
    """Return the tables that a run prints at its end."""
    regions, at = tables.regions, f"{tables.split}, step {tables.step}"
    row = map(percent, (*regions.region_ious, regions.miou))
    header = ("", *(f"IoU{n + 1}" for n in range(len(regions.region_ious))), "mIoU", "Var")
    lines = ((regions.row_label, *row, number(regions.variance)),)
    by_region = TextTable(f"IoU by region ({at})", header, lines)
    subsets = {"all images": regions.miou, **subset_mious(tables.classes)}
    rows = tuple((name, percent(value)) for name, value in subsets.items())
    grids = (by_region, class_grid(tables), TextTable("mIoU by subset", ("images", "mIoU"), rows))
    if tables.consistency is None:
        return grids
    return (*grids, consistency_grid(tables.consistency, "Consistency of two frames"))


def class_labels(classes: Sequence[str], unscored: Collection[str]) -> tuple[str, ...]:
    """Return the names of classes in tables: "car", or "background (not in means)"."""
    return tuple(f"{name} (not in means)" if name in unscored else name for name in classes)


def percent(fraction: float) -> str:
    """Write a fraction as percent with two decimals, as the papers print it."""
    return number(100.0 * fraction)


def number(value: float) -> str:
    """Write a number with two decimals; `ABSENT` for NaN."""
    return ABSENT if math.isnan(value) else f"{value:.2f}"


def without_nan(value: Any) -> Any:
    """Replace every NaN inside `value` by None, because JSON does not know it."""
    if isinstance(value, dict):
        return {key: without_nan(child) for key, child in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(child) for child in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def csv_text(rows: Iterable[Sequence[object]]) -> str:
    """Write rows, header first, as CSV; labels that a spreadsheet would execute get an "'"."""
    stream = io.StringIO()
    csv.writer(stream, lineterminator="\n").writerows([_safe(cell) for cell in row] for row in rows)
    return stream.getvalue()


def _safe(cell: object) -> object:
    text = cell.replace("\r", "\n") if isinstance(cell, str) else ""  # "\r" would not be quoted
    try:
        float(text)
    except ValueError:
        return f"'{text}" if FORMULA.match(text) else text or cell
    return text
