"""Tables of measurements, from their counts alone."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

from rich.console import Group

from rgbt.assembly.session import Session
from rgbt.data.domains import TestedHead
from rgbt.metrics import scores
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import details_of
from rgbt.metrics.metric import Regions
from rgbt.metrics.named import value
from rgbt.metrics.score_grid import score_grid
from rgbt.tables import ClassTable, RegionTable, ResultTables, TextTable, number
from rgbt.terminal import result_view, rich_table


def result_tables(counts: Counts, regions: Regions, label: str, step: int) -> ResultTables:
    """Make the tables of counts of single frames over `regions`; `label` names their row."""
    absent, scored = counts.absent, counts.scored
    matrices = counts.by_region()
    by_region = scores.tally(matrices)
    whole = by_region.sum(0)
    region_ious = scores.miou(by_region, absent, scored)
    subset_mious = {}
    for part, images in counts.parts().items():
        subset_mious[part] = float(scores.miou(scores.tally(images.whole()), absent, scored))
    return ResultTables(
        split=counts.split,
        step=step,
        region_names=tuple(f"{regions.partition}_{n + 1}" for n in range(len(by_region))),
        regions=RegionTable(
            row_label=label,
            region_ious=tuple(map(float, region_ious)),
            miou=float(scores.miou(whole, absent, scored)),
            variance=float(scores.variance(region_ious)),
        ),
        classes=ClassTable(
            names=counts.classes,
            ious=tuple(map(float, scores.iou(whole, absent))),
            accuracies=tuple(map(float, scores.recall(whole, absent))),
            region_ious=tuple(tuple(map(float, row)) for row in scores.iou(by_region, absent).T),
            subset_mious=subset_mious,
            unscored=counts.unscored,
            notes=scores.absent_notes(matrices, counts.classes, scored, counts.split, absent),
        ),
    )


def label_of(opened: Session, counts: Counts) -> str:
    """Name a measurement in tables: the network, the data set and what was changed."""
    of = counts.measurement
    return " · ".join(filter(None, (f"{opened.label} {of.dataset_name}", of.label or of.view)))


def overview(opened: Session, files: Mapping[Path, Counts], note: str = "") -> Group:
    """Show the tables of counts and their files: of single frames first, then of details."""
    (path, counts), *others = files.items()
    label, head = label_of(opened, counts), cast(TestedHead, counts.measurement.head)
    lines = [("heads", opened.domains.heads_in_words(head))] if head else []
    lines.append(("counts", f"{path} ({note})" if note else str(path)))
    for file, detailed in others:
        details = details_of(detailed.partition)
        assert details is not None, "the others are of details"
        lines.append((details.kind, str(file)))
    tables = result_tables(counts, opened.regions, label, opened.step)
    return Group(
        result_view(tables, opened.folder, [line for line in lines if line[1]]),
        *(rich_table(_details_table(detailed, label)) for _, detailed in others),
    )


def _details_table(counts: Counts, label: str) -> TextTable:
    """The scores of counts of details as a table; `label` names the network."""
    grid = score_grid(counts)
    rows = [(title, *_numbers(counts, metrics)) for title, metrics in grid.rows]
    return TextTable(f"{label}: {grid.title}", ("", *grid.columns), tuple(rows))


def views_table(by_view: Mapping[str, Counts], label: str) -> TextTable:
    """Make the table of mIoU by region, a row for each input, of counts of single frames."""
    grid = score_grid(next(iter(by_view.values())))
    rows = [(view, *_numbers(counts, grid.metrics)) for view, counts in by_view.items()]
    return TextTable(f"{label}: {grid.title} and input", ("", *grid.columns), tuple(rows))


def _numbers(counts: Counts, metrics: Sequence[str]) -> tuple[str, ...]:
    return tuple(number(value(metric, counts, counts.absent)) for metric in metrics)
