from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.result import OWN
from sweeps.plan.table import Column, Row
from sweeps.point import Outcome, Point
from sweeps.score.cells import ScoredTable, TableCell, published, score, size_marks
from tests.measured import measurement, remeasured
from tests.sweeps.tabled import FakeResult, Made, counts_of, failed, outcome, right, table

ACC = Column(name="acc", metric="pixel_accuracy")
RGB = Column(name="rgb", metric="pixel_accuracy", modality="rgb")
LESS = Column(name="less", minus=("rgb", "acc"))
ROW = (Row(label="a", experiment="crm"),)
BOTH = {
    ("a", seed): outcome(str(seed), {(): right(acc), ("modality=rgb",): right(rgb)})
    for seed, (acc, rgb) in enumerate([(50, 40), (70, 50)])
}
"""Two seeds: accuracy of 50 and 70 percent, of RGB alone 40 and 50."""


def scored(
    columns: tuple[Column, ...], runs: Any, rows: tuple[Row, ...] = ROW, **others: Any
) -> ScoredTable:
    return score("t", table(rows, columns, **others), runs, scale="demo")


def test_score_mean_sd_and_difference_by_hand() -> None:
    found = Made({"a": ((40, 50, 60), 48.0)}).scored()
    cell = found.cells["a", "acc"]
    (row,), (column,) = found.table.rows, found.table.columns
    assert (cell.mean, cell.sd, cell.seeds) == (50.0, 10.0, 3)
    assert cell.keys == ("a0", "a1", "a2")
    assert found.difference(row, column) == 2.0
    assert (found.seeds, cell.reason) == ((0, 1, 2), "")
    assert math.isnan(Made({"a": ((40,), None)}).scored().cells["a", "acc"].sd)


def test_score_derived_columns_are_per_seed() -> None:
    columns = (
        Column(name="both", mean=("rgb", "acc")),
        *(ACC, RGB, LESS),
        Column(name="gain", minus=("both", "acc")),
    )
    cells = scored(columns, BOTH).cells
    assert cells["a", "rgb"].mean == 45.0
    assert cells["a", "less"].mean == -15.0
    assert cells["a", "less"].sd == pytest.approx(math.sqrt(50))  # -10 and -20
    assert cells["a", "both"].mean == 52.5
    assert cells["a", "both"].sd == pytest.approx(math.sqrt(112.5))  # 45 and 60
    assert cells["a", "gain"].mean == -7.5  # -5 and -10


def test_score_omitted_rows_and_columns_have_no_cell() -> None:
    rows = (
        *(Row(label="a", without=("rgb",)), Row(label="b")),
        Row(label="theirs", values={"acc": 3.0, "rgb": None}),
    )
    both = {(): right(50), ("modality=rgb",): right(30)}
    runs = {("a", 0): outcome("k", right(40)), ("b", 0): outcome("l", both)}
    mean = Column(name="both", mean=("acc", "rgb"))
    found = scored((ACC, RGB, LESS, mean), runs, rows)
    assert {place: cell.mean for place, cell in found.cells.items()} == {
        ("a", "acc"): 40.0,
        ("b", "acc"): 50.0,
        ("b", "rgb"): 30.0,
        ("b", "less"): -20.0,
        ("b", "both"): 40.0,
    }
    assert published(rows[2], RGB) is None
    assert math.isnan(found.difference(rows[2], ACC))


def details_of(partition: str, *rows: list[list[int]]) -> Counts:
    """Details of one image."""
    like = counts_of(night=None).select(["00000"])
    return replace(like, counts=np.array([rows]), measurement=measurement(partition=partition))


def test_score_details_have_own_counts() -> None:
    columns = (
        ACC,
        Column(name="edge", metric="class/{class}/boundary_IoU", modality="rgb"),
        Column(name="ece", metric="ECE", best="lowest"),
    )
    # Road: both 2 of 4 and 3 boundary pixels; car: 1 of 1 and 1.
    edge = details_of("ring1-boundary-0.02", [[2, 1], [4, 1], [3, 1]])
    # 10 pixels, of which 7 are right with a confidence of 0.9 on average.
    bins = *[[[0, 0]] * 3] * 14, [[10, 0], [7, 0], [90_000, 0]]
    ece = details_of("ring1-calibration-15", *bins)
    made = {
        (): remeasured(right(50), partition="ring1"),
        ("modality=rgb", "details=boundary"): edge,
        ("details=calibration",): ece,
    }
    rows = tuple(Row(label=name, settings={"class": name}) for name in ("road", "car"))
    run = outcome("k", made)
    found = scored(columns, {("road", 0): run, ("car", 0): run}, rows)
    values = {place: cell.mean for place, cell in found.cells.items()}
    assert values["road", "edge"] == pytest.approx(100 * 2 / 5)
    assert values["car", "edge"] == pytest.approx(100.0)
    assert values["car", "ece"] == pytest.approx(20.0)
    assert values["road", "acc"] == 50.0


def test_score_sizes_have_marks_without_seeds() -> None:
    size = Column(name="size", efficiency="parameters", best="lowest")
    rows = tuple(Row(label=label, experiment="crm") for label in "abc")

    def marks(*millions: float) -> dict[str, int]:
        pairs = zip("abc", millions, strict=True)
        cells = {(label, "size"): TableCell(million, math.nan, 0) for label, million in pairs}
        found = score("t", table(rows, (ACC, size)), BOTH, scale="demo", sizes=cells)
        assert found.cells["b", "size"].mean == millions[1]
        return {label: rank for (label, _), rank in size_marks(found.table, cells).items()}

    assert marks(54.36, 44.56, 51.0) == {"b": 1, "c": 2}
    assert marks(54.36, 44.56, 44.56) == {"b": 1, "c": 1, "a": 2}
    assert marks(1.0, 1.0, 1.0) == {}


class Uncounted(FakeResult):
    def counts(self, path: str = OWN) -> Counts:
        raise InputError(f"{self.folder}/{path} does not exist")


def test_seeds_without_a_value_share_a_reason() -> None:
    runs = {("a", 0): outcome("k", right(40)), ("a", 1): failed("lost"), ("a", 2): failed("lost")}
    for seed in (3, 4):
        result: Any = Uncounted("key", {}, folder=Path(f"run{seed}"))
        runs["a", seed] = Outcome(Point("", ()), "finished", results=(result,))
    cell = scored((ACC,), runs).cells["a", "acc"]
    assert (cell.mean, cell.seeds, cell.mark) == (40.0, 1, "failed")
    assert cell.reason == f"seeds 1, 2: lost; seeds 3, 4: {OWN} does not exist"


@pytest.mark.parametrize(("absent", "wanted"), [("released", 50.0), ("exclude", math.nan)])
def test_score_absent_class_follows_table(absent: Any, wanted: float) -> None:
    """One of two classes has pixels, all right: 50 with a zero beside it, alone no score."""
    column = Column(name="mIoU", metric="mIoU")
    found = scored((column,), {("a", 0): outcome("k", right(100))}, absent=absent)
    assert found.cells["a", "mIoU"].mean == pytest.approx(wanted, nan_ok=True)
    # Without a convention of its own the table takes that of the counts.
    counted = {("a", 0): outcome("k", remeasured(right(100), absent=absent))}
    mean = scored((column,), counted).cells["a", "mIoU"].mean
    assert mean == pytest.approx(wanted, nan_ok=True)
