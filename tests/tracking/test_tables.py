"""Result tables: from counts, as JSON, as Markdown, in the terminal."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from rgbt.tracking import terminal
from rgbt.tracking.mlflow_upload import artifact_table
from rgbt.tracking.tables import (
    ClassTable,
    ConsistencyTable,
    RegionTable,
    ResultTables,
    class_grid,
    consistency_grid,
    percent,
    region_grid,
    result_grids,
    subset_grid,
    subset_mious,
)


@pytest.fixture
def tables() -> ResultTables:
    return ResultTables(
        split="test",
        step=400,
        region_names=("ring_1", "ring_2"),
        regions=RegionTable("grbm", (0.625, 0.4), 0.555555, 126.5625),
        classes=ClassTable(
            names=("road", "car"),
            ious=(0.777777, 0.333333),
            accuracies=(0.823529, 0.666666),
            region_ious=((0.75, 0.8), (0.5, 0.0)),
            subset_mious={"day": 0.4, "night": 0.3},
        ),
    )


def test_json_round_trip_keeps_nan(tables: ResultTables) -> None:
    odd = replace(tables, classes=replace(tables.classes, ious=(0.5, math.nan)))
    text = json.dumps(odd.to_json(), allow_nan=False)
    back = ResultTables.from_json(json.loads(text))
    assert back.classes.ious[0] == 0.5
    assert math.isnan(back.classes.ious[1])
    assert ResultTables.from_json(json.loads(json.dumps(tables.to_json()))) == tables


def test_notes_are_below_the_table_of_classes_in_markdown_and_in_the_terminal(
    tables: ResultTables,
) -> None:
    note = "absent from the test split: car (left out of the mean)"
    noted = replace(tables, classes=replace(tables.classes, notes=(note,)))
    assert ResultTables.from_json(json.loads(json.dumps(noted.to_json()))) == noted
    grid = class_grid(noted)
    assert grid.to_markdown().endswith(f"|\n\n- {note}\n")
    shown = Console(width=100, record=True, file=io.StringIO())
    shown.print(terminal.rich_table(grid))
    assert shown.export_text().rstrip().endswith(note)
    assert class_grid(tables).to_markdown().endswith("|\n")


def test_region_grid_has_the_papers_columns_and_two_decimals() -> None:
    ours = RegionTable("ours", (0.55283, 0.6279), 0.6124, 10.899)
    paper = RegionTable("paper", (0.5, math.nan), 0.6, 1.0)
    grid = region_grid([ours, paper])
    assert grid.header == ("", "IoU1", "IoU2", "mIoU", "Var")
    assert grid.rows[0] == ("ours", "55.28", "62.79", "61.24", "10.90")
    assert grid.rows[1] == ("paper", "50.00", "-", "60.00", "1.00")


@pytest.mark.parametrize("rows", [[], [RegionTable("a", (0.5,), 1, 0), RegionTable("b", (), 1, 0)]])
def test_region_grid_raises(rows: list[RegionTable]) -> None:
    with pytest.raises(ValueError, match="one number of regions"):
        region_grid(rows)


def test_class_and_subset_grids(tables: ResultTables) -> None:
    grid = class_grid(tables)
    assert grid.header == ("class", "IoU", "Acc", "ring_1", "ring_2")
    assert grid.rows[1] == ("car", "33.33", "66.67", "50.00", "0.00")
    assert grid.rows[-1] == ("mean", "55.56", "", "62.50", "40.00")
    # (0.4 + 0.3) / 2 is not the mIoU of the pooled pixels.
    assert subset_grid(tables).rows == (
        ("all images", percent(tables.regions.miou)),
        ("day", "40.00"),
        ("night", "30.00"),
        ("mean of day and night", "35.00"),
    )
    without_night = replace(tables.classes, subset_mious={"day": 0.4})
    assert list(subset_mious(without_night)) == ["day"]
    lines = grid.to_markdown().strip().splitlines()
    assert lines[0] == "**IoU and accuracy by class**"
    assert lines[3] == "| --- | ---: | ---: | ---: | ---: |"
    assert len(lines) == 4 + 3


def test_classes_that_are_left_out_of_means_say_so(tables: ResultTables) -> None:
    consistency = ConsistencyTable(
        ("road", "car"),
        {"next": (0.5, 0.7)},
        {"next": (0.4, 0.6)},
        {"next": 0.5},
        {"next": 0.4},
        ("car",),
    )
    classes = replace(tables.classes, unscored=("car",))
    marked = replace(tables, classes=classes, consistency=consistency)
    shown = ["road", "car (not in means)", "mean"]
    assert [row[0] for row in class_grid(marked).rows] == shown
    assert [row[0] for row in consistency_grid(consistency, "").rows] == shown
    plain = json.loads(json.dumps(marked.to_json()))
    assert ResultTables.from_json(plain) == marked
    # Of a file from before they were stored.
    del plain["classes"]["unscored"], plain["consistency"]["unscored"]
    older = replace(marked, classes=tables.classes, consistency=replace(consistency, unscored=()))
    assert ResultTables.from_json(plain) == older
    # MLflow's table keeps the names that runs are compared by.
    assert artifact_table(marked) == artifact_table(tables)


def test_terminal_shows_the_same_cells_and_never_cuts(
    tables: ResultTables, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    long = Path("/a" * 150)
    links = [("open MLflow", "mlflow ui --backend-store-uri sqlite:////x/mlflow.db")]
    terminal.print_rich(terminal.result_view(tables, long, links))
    output = capsys.readouterr()
    for grid in result_grids(tables):
        assert grid.title in output.out
        assert all(cell in output.out for row in grid.rows for cell in row)
    assert f"run folder   {long}\n" in output.out
    assert "open MLflow  mlflow ui --backend-store-uri sqlite:////x/mlflow.db\n" in output.out
    assert output.err == ""
