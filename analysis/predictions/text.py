"""Score tables as grids of text, Markdown and tidy CSV, and remarks about them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

from analysis.predictions.folder import listed
from analysis.predictions.scoring import FolderScores
from analysis.predictions.table import ALL, Metric, Score, ScoreKey, ScoreTable
from rgbt.checks import without_controls
from rgbt.metrics.metric import Absent
from rgbt.metrics.names import MACC, MIOU
from rgbt.tables import ABSENT, TextTable, class_labels, csv_text, number

COLUMNS = (
    *("method", "split", "partition", "images", "num_images", "region", "class", "metric"),
    *("absent", "value", "low", "high"),
)
WHOLE = "whole"
"""Row or region of the whole image."""


def grids(table: ScoreTable) -> tuple[TextTable, ...]:
    """The tables of one method on one partition.

    Returns:
        mIoU, mAcc and the IoU of each class by region; the accuracy of each class by region; day
        and night. Means under both conventions for absent classes where these differ; percent.
    """
    return region_grid(table), accuracy_grid(table), part_grid(table)


def region_grid(table: ScoreTable) -> TextTable:
    """Columns: regions and the whole image; rows: mIoU, mAcc, IoU of each class."""
    means: tuple[tuple[str, Metric], ...] = ((MIOU, "IoU"), (MACC, "Acc"))
    rows = []
    for name, metric in means:
        conventions = table.conventions(metric)
        for absent in conventions:
            scores = _by_region(table, ScoreKey(metric=metric, absent=absent))
            rows.append((f"{name}{_ending(absent, conventions)}", *scores))
    title = f"{_title(table)}: mIoU, mAcc and IoU of each class by region"
    return TextTable(title, _header(table), (*rows, *_class_rows(table, "IoU")))


def accuracy_grid(table: ScoreTable) -> TextTable:
    """Columns: regions and the whole image; rows: accuracy of each class."""
    title = f"{_title(table)}: accuracy of each class by region"
    return TextTable(title, _header(table), _class_rows(table, "Acc"))


def part_grid(table: ScoreTable) -> TextTable:
    """Rows: all images, day, night; columns: mIoU, variance, mAcc, mIoU of each region."""
    conventions = table.conventions()
    numbers = range(1, table.regions + 1)
    header = ("images", "mIoU", "Var", "mAcc", *(f"IoU{region}" for region in numbers))
    rows = []
    for images, num_images in table.num_images.items():
        for absent in conventions:
            cell = ScoreKey(images=images, absent=absent)
            cells = [cell, replace(cell, metric="Var"), replace(cell, metric="Acc")]
            cells += [replace(cell, region=region) for region in numbers]
            label = f"{images} ({num_images}){_ending(absent, conventions)}"
            scores = [table.scores[each] for each in cells]
            # The intervals of regions have a separate table; here they would be too wide.
            shown = [*map(_with_interval, scores[:2]), *(number(each.value) for each in scores[2:])]
            rows.append((label, *shown))
    return TextTable(f"{_title(table)}: all images, day and night", header, tuple(rows))


def convention_line(table: ScoreTable) -> str:
    """One line: whether the conventions for absent classes differ, and what "-" stands for."""
    absent = ", ".join(table.absent_classes())
    if not absent:
        every = "every class of the means" if table.unscored else "every class"
        return (
            f"{table.partition}: {every} has pixels in every region, so that both conventions "
            "for absent classes (released: 0, exclude: left out) give the same numbers."
        )
    differ = len(table.conventions()) > 1
    return (
        f"{table.partition}: {absent}: no pixel to count in some region or part ({ABSENT} in the "
        "tables of classes); "
        + (
            "released counts that as 0, exclude leaves the class out of the mean; "
            f"{table.absent} is the convention of the data set."
            if differ
            else "released counts that as 0, exclude leaves it out; the means are the same."
        )
    )


def remarks_on(scored: FolderScores) -> list[str]:
    """Remarks about the folder that a reader of the numbers needs, one sentence each."""
    found = scored.found
    remarks = []
    if found.missing:
        number = len(found.missing) + len(found.paths)
        remarks.append(
            f"{len(found.missing)} of {number} images of the split have no prediction and are left "
            f"out of every number ({listed(found.missing)})."
        )
    for sizes, number in Counter(scored.resized.values()).items():
        remarks.append(
            f"{number} predictions were resized to their label by the nearest pixel, from {sizes}."
        )
    if found.extra:
        remarks.append(
            f"{len(found.extra)} other PNG files of the folder belong to no image of the split and "
            f"were not read ({listed(found.extra)})."
        )
    if scored.maps is None:
        remarks.append("The images differ in size, so there is no map by pixel.")
    return remarks


def markdown(title: str, tables: Sequence[ScoreTable], remarks: Sequence[str]) -> str:
    """One page: remarks, then the tables of each partition."""
    heading = [f"# {title}", "", *(f"- {remark}" for remark in remarks)]
    lines = [without_controls(line.replace("\n", "?")) for line in heading]
    for table in tables:
        lines += ["", *filter(None, (convention_line(table), table.intervals))]
        lines += [f"\n{grid.to_markdown()}".rstrip("\n") for grid in grids(table)]
    return "\n".join(lines) + "\n"


def tidy_csv(tables: Sequence[ScoreTable]) -> str:
    """One line per score, under both conventions for absent classes, also where they agree.

    Columns: `COLUMNS`. region: "whole" or 1..R; class: "mean" or its name; value, low and high in
    percent (Var: squared percent points), empty where there is none. Where every mean is the same
    under both conventions, intervals stand with "released" alone.
    """
    rows: list[tuple[object, ...]] = [COLUMNS]
    for table in tables:
        for cell, score in table.scores.items():
            of = (cell.region or WHOLE, cell.class_name or "mean", cell.metric, cell.absent)
            where = (table.name, table.split, table.partition, cell.images)
            values = map(_plain, (score.value, score.low, score.high))
            rows.append((*where, table.num_images[cell.images], *of, *values))
    return csv_text(rows)


def _title(table: ScoreTable) -> str:
    return f"{table.name}, {table.split} ({table.num_images[ALL]} images), {table.partition}"


def _ending(absent: Absent, conventions: Sequence[Absent]) -> str:
    return f" {absent}" if len(conventions) > 1 else ""


def _header(table: ScoreTable) -> tuple[str, ...]:
    return ("", *(f"region {number}" for number in range(1, table.regions + 1)), WHOLE)


def _class_rows(table: ScoreTable, metric: Metric) -> tuple[tuple[str, ...], ...]:
    """Absent classes as "-"; `convention_line` says how they count."""
    cell = ScoreKey(metric=metric, absent="exclude")
    labelled = zip(class_labels(table.classes, table.unscored), table.classes, strict=True)
    return tuple(
        (label, *_by_region(table, replace(cell, class_name=name))) for label, name in labelled
    )


def _by_region(table: ScoreTable, cell: ScoreKey) -> list[str]:
    cells = [replace(cell, region=region) for region in (*range(1, table.regions + 1), None)]
    return [_with_interval(table.scores[each]) for each in cells]


def _with_interval(score: Score) -> str:
    if math.isnan(score.low):
        return number(score.value)
    return f"{number(score.value)} [{score.low:.1f}, {score.high:.1f}]"


def _plain(value: float) -> str:
    return "" if math.isnan(value) else f"{value:.6g}"
