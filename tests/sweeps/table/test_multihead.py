"""The tables of Multi-head: domains, heads and decoders as rows, teachers and stages before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from sweeps.evaluation import ExtraEvaluation
from sweeps.table.load_table import load_table
from sweeps.table.request import TableRequest
from sweeps.table.table import Row
from tests.sweeps.composed import checked, row_config

NUMBERS = (1, 2, 3, 4, 5)
TABLES = {number: load_table(f"multihead/table{number}", Path("none")) for number in NUMBERS}
OURS = [
    pytest.param(number, row, id=f"table{number}: {row.label}")
    for number in NUMBERS
    for row in TABLES[number].rows
    if row.experiment is not None
]


def config_of(number: int, row: Row, scale: str = "demo") -> Any:
    return row_config(TABLES[number], row, scale)


def first_stage(config: Any) -> Any:
    """The configuration of the stage before, where there is one."""
    before = str(config.model.weights).removeprefix("experiment:").partition("/")[0]
    return config if before == "None" else checked((f"+experiment={before}", "scale=demo"))


def row_of(number: int, label: str) -> Row:
    (row,) = (row for row in TABLES[number].rows if row.label == label)
    return row


@pytest.mark.parametrize(("number", "row"), OURS)
def test_row_settings_equal_printed_settings(number: int, row: Row) -> None:
    config = config_of(number, row)
    source, target = config.domains.source, config.domains.target
    heads = {each.head for each in (source, target) if each is not None}
    first = first_stage(config)
    scheme = str(config.scheme["_target_"]) + str(config.scheme.get("unlabelled"))
    adaptations = {"Adversarial": "adversarial", "MaxSquares": "maximum_squares_loss"}
    found = {
        "heads": len(heads),
        "modified_decoder": config.model.get("decoder", "basic") != "basic",
        "adaptation": next((a for word, a in adaptations.items() if word in scheme), None),
        "seg_loss_on_thermal": first.domains.target is not None,
        "init_from_rgb_to_thermal": "thermal" in str(first.model.weights),
    }
    shared = set(found) & set(row.settings)
    assert {key: found[key] for key in shared} == {key: row.settings[key] for key in shared}


def test_every_row_of_the_thesis_runs() -> None:
    for number, table in TABLES.items():
        assert table.needs is None
        for row in table.rows:
            ours = (row.origin or "own").startswith("own")
            assert table.runnable(row) == ours, (number, row.label)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_the_printed_mean_is_that_of_both_columns(number: int) -> None:
    mean = next(column for column in TABLES[number].columns if column.name == "mean_mIoU")
    for row in TABLES[number].rows:
        both = [row.values.get(name) for name in mean.sources]
        printed = row.values.get("mean_mIoU")
        known = [value for value in (*both, printed) if value is not None]
        if len(known) == 3:
            assert known[2] == pytest.approx((known[0] + known[1]) / 2, abs=0.0501), row.label


def test_what_a_network_cannot_be_asked_is_left_out() -> None:
    three, four = (TableRequest("t", TABLES[number], "demo", (0,)) for number in (3, 4))
    thermal, day = ExtraEvaluation("thermal"), ExtraEvaluation(head="source")
    assert three.evaluations(["HeatNet*"]) == ()
    assert three.evaluations(["Multi-head"]) == (thermal,)
    assert four.evaluations(["HeatNet RGB-only*"]) == ()
    assert four.evaluations(["Multi-head"]) == (day,)
    left = [column.name for column in TABLES[3].columns_of(row_of(3, "HeatNet*"))]
    assert left == ["mIoU_rgb"]


@pytest.mark.parametrize("scale", ["demo", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "cells",
    [
        [(2, "HeatNet (reproduced)", "mIoU_day"), (3, "HeatNet*", "mIoU_rgb")],
        [
            (2, "HeatNet RGB-only (reproduced)", "mIoU_day"),
            (4, "HeatNet RGB-only*", "mIoU_day"),
        ],
    ],
)
def test_rows_that_are_printed_twice_are_one_run(
    cells: list[tuple[int, str, str]], scale: str
) -> None:
    overrides = {
        TABLES[number].overrides(row_of(number, label), scale) for number, label, _ in cells
    }
    printed = {row_of(number, label).values[column] for number, label, column in cells}
    assert (len(overrides), len(printed)) == (1, 1)


def test_rows_of_a_table_are_different_runs() -> None:
    for number, table in TABLES.items():
        wanted = TableRequest("t", table, "demo", (0,))
        runs = [row for row in table.rows if table.runnable(row)] if number < 5 else []
        assert len(wanted.points()) == len(runs)


@pytest.mark.slow  # that of its experiment is looked at in tests/test_config.py
@pytest.mark.parametrize(("number", "row"), OURS)
def test_row_at_paper_scale_trains_on_freiburg(number: int, row: Row) -> None:
    config = config_of(number, row, "paper")
    assert (config.dataset.name, config.dataset.num_classes) == ("freiburg", 14)
    assert config.model.num_classes == 14
