"""Result tables as JSON, Markdown and CSV, and on terminals of any width."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console

from rgbt.tables import (
    ClassTable,
    ConsistencyTable,
    RegionTable,
    ResultTables,
    TextTable,
    class_grid,
    consistency_grid,
    csv_text,
    percent,
    result_grids,
)
from rgbt.terminal import info, path_lines, print_rich, result_view, rich_table
from rgbt.tracking.mlflow_upload import artifact_table

FORMULAS = ["=1+1", "+cmd|' /C calc'!A0", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "'=1", "''-a", "-"]
TEXTS = ["", "plain", "'quoted'", "a=b", "grbm, seed=1", "-1.25", "+3e5", "-inf", "1", 'say "x"']
NUMBERS = ("48.75 ± 1.22", "-1.64", "-2.20 to -1.01", "454482993c6b")
GRID = TextTable(
    "A title that is by far longer than the table of two columns below it",
    ("", "grbm sigma_div=1 of three seeds", "difference", "95 % over images", "run"),
    tuple((f"sigma_div={n} max_steps=240 · grbm", *NUMBERS) for n in (1, 2)),
    ("a note",),
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


def test_json_round_trip_keeps_nan_and_notes(tables: ResultTables) -> None:
    odd = replace(tables, classes=replace(tables.classes, ious=(0.5, math.nan)))
    back = ResultTables.from_json(json.loads(json.dumps(odd.to_json(), allow_nan=False)))
    assert back.classes.ious[0] == 0.5
    assert math.isnan(back.classes.ious[1])
    noted = replace(tables, classes=replace(tables.classes, notes=("a note",)))
    assert ResultTables.from_json(json.loads(json.dumps(noted.to_json()))) == noted
    assert class_grid(noted).to_markdown().endswith("|\n\n- a note\n")


def test_grids_have_the_papers_columns_and_two_decimals(tables: ResultTables) -> None:
    ours = RegionTable("ours", (0.55283, math.nan), 0.6124, 10.899)
    grid, *_ = result_grids(replace(tables, regions=ours))
    assert grid.header == ("", "IoU1", "IoU2", "mIoU", "Var")
    assert grid.rows == (("ours", "55.28", "-", "61.24", "10.90"),)
    grid = class_grid(tables)
    assert grid.header == ("class", "IoU", "Acc", "ring_1", "ring_2")
    assert grid.rows[1] == ("car", "33.33", "66.67", "50.00", "0.00")
    assert grid.rows[-1] == ("mean", "55.56", "", "62.50", "40.00")
    # (0.4 + 0.3) / 2 is not the mIoU of the pooled pixels.
    assert result_grids(tables)[2].rows == (
        ("all images", percent(tables.regions.miou)),
        ("day", "40.00"),
        ("night", "30.00"),
        ("mean of day and night", "35.00"),
    )


def test_classes_that_are_left_out_of_means_say_so(tables: ResultTables) -> None:
    by_class, mean = ({"next": (0.5, 0.7)}, {"next": (0.4, 0.6)}), ({"next": 0.5}, {"next": 0.4})
    consistency = ConsistencyTable(("road", "car"), *by_class, *mean, ("car",))
    classes = replace(tables.classes, unscored=("car",))
    marked = replace(tables, classes=classes, consistency=consistency)
    shown = ["road", "car (not in means)", "mean"]
    assert [row[0] for row in class_grid(marked).rows] == shown
    assert [row[0] for row in consistency_grid(consistency, "").rows] == shown
    assert ResultTables.from_json(json.loads(json.dumps(marked.to_json()))) == marked
    # MLflow's table keeps the names that runs are compared by.
    assert artifact_table(marked) == artifact_table(tables)


def test_printed_result_has_all_cells_and_whole_paths(
    tables: ResultTables, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "20")
    long = Path("/a" * 150)
    print_rich(result_view(tables, long, [("open MLflow", "rgbt ui")]))
    output = capsys.readouterr()
    for grid in result_grids(tables):
        assert all(cell in output.out for row in grid.rows for cell in row)
    assert f"run folder   {long}\nopen MLflow  rgbt ui\n" in output.out


@pytest.mark.parametrize("width", [20, 80, 200])
def test_table_numbers_and_keys_are_whole_at_any_width(width: int) -> None:
    console = Console(width=width)
    with console.capture() as captured:
        console.print(rich_table(GRID), soft_wrap=True)
    text = captured.get()
    assert text.startswith(f"{GRID.title}\n"), "not broken: what it names can be copied"
    assert [text.count(number) for number in NUMBERS] == [2] * len(NUMBERS)
    if width >= 80:
        assert max(map(len, text.splitlines())) <= max(width, 82)


def test_control_characters_never_reach_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    name = "a\x1b[31m\x07[red]"
    print_rich(rich_table(TextTable(name, (name, name), ((name, name),), (name,))))
    print_rich(path_lines([(name, name)]))
    info(name)
    output = capsys.readouterr()
    for text in (output.out, output.err):
        assert "a?[31m?[red]" in text
        assert not {"\x1b", "\x07"} & set(text)


def test_csv_formulas_become_text_and_lose_nothing() -> None:
    text = csv_text([["=head", "n"], *([label, -1.25] for label in FORMULAS + TEXTS)])
    _, *rows = csv.reader(io.StringIO(text, newline=""))
    assert text.startswith("'=head,n\n")
    given = [label.replace("\r", "\n") for label in FORMULAS + TEXTS]
    for (cell, number), original, raw in zip(rows, given, FORMULAS + TEXTS, strict=True):
        assert cell == (f"'{original}" if raw in FORMULAS else original)
        assert number == "-1.25"
    marked = (
        (cell, raw in FORMULAS) for (cell, _), raw in zip(rows, FORMULAS + TEXTS, strict=True)
    )
    assert [cell[1:] if is_formula else cell for cell, is_formula in marked] == given
