"""The tables of Temporal: losses and views as rows, two protocols as columns."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sweeps.evaluation import ExtraEvaluation
from sweeps.table.load_table import load_table
from sweeps.table.request import TableRequest
from sweeps.table.table import Row
from tests.sweeps.composed import row_config

NUMBERS = (1, 2, 3, 4, 5)
TABLES = {number: load_table(f"temporal/table{number}", Path("none")) for number in NUMBERS}
OURS = [
    pytest.param(number, row, id=f"table{number}: {row.label}")
    for number in NUMBERS
    for row in TABLES[number].rows
    if row.experiment is not None
]
SECOND = {"none": [], "dice": ["dice2"], "con": ["con"], "con_acc": ["con-acc"]}


def config_of(number: int, row: Row) -> Any:
    return row_config(TABLES[number], row)


@pytest.mark.parametrize(("number", "row"), OURS)
def test_row_losses_equal_printed_losses(number: int, row: Row) -> None:
    config = config_of(number, row)
    first, second = ["seg1"], []
    if "second" in config.loss:
        first += ["dice1"] if config.loss.alpha else []
        second = ["seg2", *SECOND[config.loss.second]]
        assert bool(config.loss.beta) == (config.loss.second != "none")
        assert config.loss.form == "paper"
    assert (row.settings["losses_img1"], row.settings["losses_img2"]) == (first, second)
    assert row.settings["network"] in config.model["_target_"].lower()


@pytest.mark.parametrize("row", TABLES[2].rows, ids=lambda row: row.label)
def test_row_views_equal_printed_views(row: Row) -> None:
    scheme = config_of(2, row).scheme
    mode = scheme.view.mode if "view" in scheme else "neither"
    turns, moves = row.settings["rotation"], row.settings["translation"]
    assert (turns, moves) == (mode in ("rotation", "both"), mode in ("translation", "both"))


def test_rows_of_first_tables_are_runnable() -> None:
    for number, table in TABLES.items():
        for row in table.rows:
            assert table.runnable(row) or number > 3 and not row.proposed, (number, row.label)


@pytest.mark.parametrize("number", [1, 2, 3])
def test_the_printed_columns_are_of_the_released_protocol(number: int) -> None:
    columns = TABLES[number].columns[-4:]
    assert [(c.name, c.metric, c.frames, c.printed) for c in columns] == [
        ("TC", "TC", "released", True),
        ("CA", "CA_released", "released", True),
        ("TC aligned", "TC", "aligned", False),
        ("CA aligned", "CA", "aligned", False),
    ]
    assert TableRequest("t", TABLES[number], "demo", (0,)).evaluations() == (
        ExtraEvaluation(frames="released"),
        ExtraEvaluation(frames="aligned"),
    )
    assert any("come from the released protocol" in remark for remark in TABLES[number].remarks)


def test_rtfnet_backbones_differ_at_paper_scale_only() -> None:
    wanted = {scale: TableRequest("t", TABLES[5], scale, (0,)) for scale in ("demo", "paper")}
    assert [len(each.points()) for each in wanted.values()] == [1, 2]
    assert wanted["paper"].models() == {"rtfnet_50", "rtfnet_152"}
