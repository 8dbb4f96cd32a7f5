"""The tables of a result as data, and as grids of text for the terminal and MLflow.

Nothing is computed here but percentages and the mean of day and night; the scores come from
`rgbt.metrics.scores`.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rgbt.metrics.names import DAY, NIGHT

ABSENT = "-"
"""Shown for an undefined score, e.g. the IoU of a class that occurs nowhere."""


@dataclass(frozen=True)
class RegionTable:
    """One row of a per-region table, as the papers print it.

    Attributes:
        row_label: method of the row, e.g. "grbm (ours, seed 0)" or "GRBM (paper)".
        region_ious: R mean IoUs, fractions; region 1 first.
        miou: mean IoU of the whole image (pooled over regions), fraction.
        variance: population variance over regions of the IoU in percent (squared percent points).
    """

    row_label: str
    region_ious: tuple[float, ...]
    miou: float
    variance: float


@dataclass(frozen=True)
class ClassTable:
    """Scores by class.

    Attributes:
        names: K class names.
        ious: K fractions over the whole image; NaN where the class is absent.
        accuracies: K fractions (recall), same rule.
        region_ious: K rows of R fractions, IoU of the class inside each region.
        subset_mious: mean IoU of subsets of the images, e.g. {"day": 0.41, "night": 0.38}.
        unscored: names of the classes that are left out of every mean.
        notes: footnotes about absent classes (`rgbt.metrics.absent`).
    """

    names: tuple[str, ...]
    ious: tuple[float, ...]
    accuracies: tuple[float, ...]
    region_ious: tuple[tuple[float, ...], ...]
    subset_mious: Mapping[str, float]
    unscored: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class ConsistencyTable:
    """Agreement of the predictions of two frames, by class; fractions, NaN without pixels.

    Attributes:
        names: K class names.
        tc: protocol ("aligned", "released", "next") -> K values of temporal consistency.
        ca: the same of consistent accuracy.
        mean_tc: protocol -> mean over classes.
        mean_ca: protocol -> mean over classes.
        unscored: names of the classes that are left out of the means.
    """

    names: tuple[str, ...]
    tc: Mapping[str, tuple[float, ...]]
    ca: Mapping[str, tuple[float, ...]]
    mean_tc: Mapping[str, float]
    mean_ca: Mapping[str, float]
    unscored: tuple[str, ...] = ()


@dataclass(frozen=True)
class ResultTables:
    """All tables of one evaluation.

    Attributes:
        split: "val" or "test".
        region_names: R names, e.g. "ring_1", the innermost ring.
        consistency: of two frames, where the run measured it.
    """

    split: str
    step: int
    region_names: tuple[str, ...]
    regions: RegionTable
    classes: ClassTable
    consistency: ConsistencyTable | None = None

    def to_json(self) -> dict[str, Any]:
        """Plain values; NaN becomes None."""
        return dict(without_nan(asdict(self)))

    @classmethod
    def from_json(cls, plain: Mapping[str, Any]) -> ResultTables:
        """The inverse of `to_json`."""
        values = _with_nan(plain)
        values["regions"] = RegionTable(**values["regions"])
        values["classes"] = ClassTable(**values["classes"])
        is_consistent = plain.get("consistency") is not None
        values["consistency"] = ConsistencyTable(**values["consistency"]) if is_consistent else None
        return cls(**values)


@dataclass(frozen=True)
class TextTable:
    """A table of text: first column labels, the others numbers; footnotes."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    notes: tuple[str, ...] = ()

    def to_markdown(self) -> str:
        """The table in Markdown, with the title in bold above it and its footnotes below."""
        rule = ["---", *["---:"] * (len(self.header) - 1)]
        lines = ["| " + " | ".join(row) + " |" for row in (self.header, rule, *self.rows)]
        notes = ["", *(f"- {note}" for note in self.notes)] if self.notes else []
        return "\n".join([f"**{self.title}**", "", *lines, *notes]) + "\n"


def region_grid(rows: Sequence[RegionTable], title: str = "IoU by region") -> TextTable:
    """Per-region rows, one below the other, in the form of the papers' tables.

    Args:
        rows: all with the same number R of regions.
        title: shown above.

    Returns:
        columns: label, IoU1 .. IoUR, mIoU (percent), Var (squared percent points).

    Raises:
        ValueError: no rows, or rows of different R.
    """
    counts = {len(row.region_ious) for row in rows}
    if len(counts) != 1:
        raise ValueError(f"{title}: expected rows with one number of regions, got {counts}.")
    header = ("", *(f"IoU{index + 1}" for index in range(counts.pop())), "mIoU", "Var")
    text = tuple(
        (row.row_label, *map(percent, (*row.region_ious, row.miou)), number(row.variance))
        for row in rows
    )
    return TextTable(title, header, text)


def class_grid(tables: ResultTables) -> TextTable:
    """IoU and accuracy by class over the image, then the class's IoU in every region; percent.

    Classes that are left out of the means say so.
    """
    classes = tables.classes
    labels = class_labels(classes.names, classes.unscored)
    header = ("class", "IoU", "Acc", *tables.region_names)
    rows = [
        (name, *map(percent, (iou, accuracy, *by_region)))
        for name, iou, accuracy, by_region in zip(
            labels, classes.ious, classes.accuracies, classes.region_ious, strict=True
        )
    ]
    regions = tables.regions
    mean = ("mean", percent(regions.miou), "", *map(percent, regions.region_ious))
    return TextTable("IoU and accuracy by class", header, (*rows, mean), classes.notes)


def subset_grid(tables: ResultTables) -> TextTable:
    """MIoU of all images and of each subset, percent."""
    subsets = {"all images": tables.regions.miou, **subset_mious(tables.classes)}
    rows = tuple((name, percent(value)) for name, value in subsets.items())
    return TextTable("mIoU by subset", ("images", "mIoU"), rows)


def subset_mious(classes: ClassTable) -> dict[str, float]:
    """Mean IoU of the subsets, and of day and night their mean, which the thesis prints.

    It is not the mIoU of all images, of which the pixels are pooled.
    """
    found: dict[str, float] = {}
    for name, value in classes.subset_mious.items():
        found[name] = value
        if name == NIGHT and DAY in found:
            found["mean of day and night"] = (found[DAY] + value) / 2
    return found


def consistency_grid(table: ConsistencyTable, title: str) -> TextTable:
    """TC and CA by class, one pair of columns per protocol; percent."""
    header = ("class", *(f"{score} {protocol}" for protocol in table.tc for score in ("TC", "CA")))
    columns = [
        values for protocol in table.tc for values in (table.tc[protocol], table.ca[protocol])
    ]
    means = [value for p in table.tc for value in (table.mean_tc[p], table.mean_ca[p])]
    labels = class_labels(table.names, table.unscored)
    rows = [(name, *map(percent, row)) for name, *row in zip(labels, *columns, strict=True)]
    return TextTable(title, header, (*rows, ("mean", *map(percent, means))))


def result_grids(tables: ResultTables) -> tuple[TextTable, ...]:
    """The tables that a run prints at its end."""
    where = f"{tables.split}, step {tables.step}"
    grids = (
        region_grid([tables.regions], f"IoU by region ({where})"),
        class_grid(tables),
        subset_grid(tables),
    )
    if tables.consistency is None:
        return grids
    return (*grids, consistency_grid(tables.consistency, "Consistency of two frames"))


def class_labels(classes: Sequence[str], unscored: Collection[str]) -> tuple[str, ...]:
    """Names of classes in tables: "car", or "background (not in means)"."""
    return tuple(f"{name} (not in means)" if name in unscored else name for name in classes)


def percent(fraction: float) -> str:
    """A fraction as percent with two decimals, as the papers print it."""
    return number(100.0 * fraction)


def number(value: float) -> str:
    """Two decimals; `ABSENT` for NaN."""
    return ABSENT if math.isnan(value) else f"{value:.2f}"


def without_nan(value: Any) -> Any:
    """`value` with None for every NaN inside, which JSON does not know."""
    if isinstance(value, dict):
        return {key: without_nan(child) for key, child in value.items()}
    if isinstance(value, list | tuple):
        return [without_nan(child) for child in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def _with_nan(value: Any) -> Any:
    """The inverse of `without_nan`, with tuples for lists."""
    if isinstance(value, dict):
        return {key: _with_nan(child) for key, child in value.items()}
    if isinstance(value, list):
        return tuple(map(_with_nan, value))
    return math.nan if value is None else value
