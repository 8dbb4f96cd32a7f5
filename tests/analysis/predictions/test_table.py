from __future__ import annotations

import csv
import io
from dataclasses import replace

import numpy as np
import pytest

from analysis.predictions.table import (
    ScoreKey,
    ScoreTable,
    interval_cells,
    score_table,
    with_intervals,
)
from analysis.predictions.text import (
    COLUMNS,
    accuracy_grid,
    convention_line,
    markdown,
    part_grid,
    region_grid,
    tidy_csv,
)
from rgbt.metrics.counts import Counts
from rgbt.metrics.named import value
from tests.analysis.counts import counts_of

FIRST = [[[4, 0, 0], [1, 3, 0], [0, 0, 0]], [[4, 0, 0], [0, 0, 0], [1, 1, 1]]]
SECOND = [[[8, 0, 0], [0, 0, 0], [0, 0, 0]]] * 2


def counts(*images: object, night: tuple[bool, ...] | None = (False, True)) -> Counts:
    classes = ("ground", "car", "person")
    return counts_of(np.array(images), night=night, classes=classes, partition="vertical2")


@pytest.fixture
def table() -> ScoreTable:
    return score_table(counts(FIRST, SECOND), "ours")


def test_scores_by_hand(table: ScoreTable) -> None:
    def score(**keys: object) -> float:
        return table.scores[replace(ScoreKey(images="day"), **keys)].value  # type: ignore[arg-type]

    # Day is the first image alone. Left: ground 4/5, car 3/4, no person; right: 4/5, 0/1, 1/3.
    assert score(region=1, class_name="ground") == pytest.approx(80)
    assert score(region=1, class_name="car") == pytest.approx(75)
    assert score(region=1, class_name="person") == 0
    assert np.isnan(score(region=1, class_name="person", absent="exclude"))
    left, right = (80 + 75 + 0) / 3, (80 + 0 + 100 / 3) / 3
    assert score(region=1) == pytest.approx(left)
    assert score(region=1, absent="exclude") == pytest.approx((80 + 75) / 2)
    assert score(region=2) == pytest.approx(right)
    assert score(metric="Var") == pytest.approx(((left - right) / 2) ** 2)
    assert score(metric="Var", absent="exclude") == pytest.approx(((77.5 - right) / 2) ** 2)
    # Whole image: ground 8/10, car 3/5, person 1/3; recall 8/8, 3/4, 1/3.
    assert score() == pytest.approx((80 + 60 + 100 / 3) / 3)
    assert score(metric="Acc") == pytest.approx((100 + 75 + 100 / 3) / 3)
    # Car is predicted on the right, where it has no label: an IoU of 0, but no accuracy.
    assert score(region=2, class_name="car", absent="exclude") == 0
    assert np.isnan(score(region=2, class_name="car", metric="Acc", absent="exclude"))
    # All images: 16 more of ground that are right.
    assert table.scores[ScoreKey(class_name="ground")].value == pytest.approx(100 * 24 / 26)
    assert table.num_images == {"all": 2, "day": 1, "night": 1}


def test_scores_are_those_that_carry_the_metrics_name(table: ScoreTable) -> None:
    counted = counts(FIRST, SECOND)
    named = {cell: cell.metric_name for cell in table.scores}
    asked = {cell: name for cell, name in named.items() if name is not None}
    assert {"mIoU", "day/Var", "night/region/2", "class/car/acc", "day/class/car/region/1"} <= {
        *asked.values()
    }
    for cell, name in asked.items():
        expected = value(name, counted, cell.absent)
        np.testing.assert_allclose(table.scores[cell].value, expected, err_msg=name)
    without = {(cell.metric, cell.region is None) for cell in named.keys() - asked.keys()}
    assert without == {("Acc", False)}


def test_conventions_are_side_by_side_only_where_they_differ(table: ScoreTable) -> None:
    assert table.conventions() == ("released", "exclude")
    assert table.absent_classes() == ("car", "person")
    assert "released counts that as 0, exclude leaves the class out" in convention_line(table)
    labels = [row[0] for row in region_grid(table).rows]
    assert labels[:2] == ["mIoU released", "mIoU exclude"]
    full = score_table(counts(np.ones((2, 3, 3), int), np.ones((2, 3, 3), int)), "ours")
    assert full.conventions() == ("released",)
    assert "the same numbers" in convention_line(full)
    assert [row[0] for row in region_grid(full).rows[:3]] == ["mIoU", "mAcc", "ground"]
    assert [row[0] for row in part_grid(full).rows] == ["all (2)", "day (1)", "night (1)"]


def test_one_mean_may_differ_where_another_does_not() -> None:
    """A class that is predicted everywhere and labelled nowhere: IoU 0, accuracy 0 or left out."""
    never = [[[2, 1, 0], [0, 0, 0], [0, 0, 1]]] * 2
    found = score_table(counts(never, night=None), "ours")
    assert found.conventions("IoU") == ("released",)
    assert found.conventions("Acc") == ("released", "exclude")
    labels = [row[0] for row in region_grid(found).rows]
    assert labels[:3] == ["mIoU", "mAcc released", "mAcc exclude"]


def test_grids_show_the_numbers(table: ScoreTable) -> None:
    grid = region_grid(table)
    assert grid.header == ("", "region 1", "region 2", "whole")
    # Both images. Left: ground 12/13, car 3/4, no person; right: ground 12/13, car 0, person 1/3.
    assert grid.rows[0] == ("mIoU released", "55.77", "41.88", "61.88")
    assert grid.rows[1] == ("mIoU exclude", "83.65", "41.88", "61.88")
    assert grid.rows[-2:] == (("car", "75.00", "0.00", "60.00"), ("person", "-", "33.33", "33.33"))
    accuracy = accuracy_grid(table)
    assert accuracy.rows[1] == ("car", "75.00", "-", "75.00")
    parts = part_grid(table)
    assert parts.header == ("images", "mIoU", "Var", "mAcc", "IoU1", "IoU2")
    assert parts.rows[2] == ("day (1) released", "57.78", "48.23", "69.44", "51.67", "37.78")


def test_intervals_are_beside_their_scores(table: ScoreTable) -> None:
    cells = interval_cells(table, "exclude")
    names = ("mIoU", "region/1", "region/2", "Var")
    assert {part: list(each) for part, each in cells.items()} == {
        part: [f"{'' if part == 'all' else part + '/'}{name}" for name in names]
        for part in ("all", "day", "night")
    }
    found = with_intervals(table, {cells["all"]["region/1"]: (80.04, 85.0)}, "said")
    assert region_grid(found).rows[1][1] == "83.65 [80.0, 85.0]"
    assert region_grid(found).rows[0][1] == "55.77"
    assert "said" in markdown("Scores", [found], ["a remark"])


def test_the_csv_is_tidy(table: ScoreTable) -> None:
    cells = interval_cells(table, "released")
    found = with_intervals(table, {cells["night"]["night/Var"]: (0.0, 1.5)}, "said")
    rows = list(csv.DictReader(io.StringIO(tidy_csv([found]))))
    assert tuple(rows[0]) == COLUMNS
    assert len(rows) == len(table.scores) == 3 * 2 * (3 * 2 * 4 + 1)

    def row(**wanted: str) -> dict[str, str]:
        (only,) = (each for each in rows if wanted.items() <= each.items())
        return only

    car = row(images="day", region="1", metric="IoU", absent="exclude", **{"class": "car"})
    assert (car["value"], car["low"], car["num_images"]) == ("75", "", "1")
    person = row(images="day", region="1", metric="IoU", absent="exclude", **{"class": "person"})
    assert person["value"] == ""
    spread = row(images="night", region="whole", metric="Var", absent="released")
    assert (spread["class"], spread["low"], spread["high"]) == ("mean", "0", "1.5")
