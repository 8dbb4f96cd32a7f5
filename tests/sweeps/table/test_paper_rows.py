"""The rows of the papers' tables: their configurations, their printed settings and values."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from omegaconf import DictConfig, OmegaConf

from rgbt.config.component import build
from sweeps.table.load_table import load_table, table_names
from sweeps.table.request import TableRequest
from sweeps.table.table import Row, Table
from tests.composed import row_spec

TABLES = {name: load_table(name) for name in table_names(Path("none"))}
SECOND = {"none": [], "dice": ["dice2"], "con": ["con"], "con_acc": ["con-acc"]}
"""Losses of the second view by the setting of the loss of Temporal."""


def rows_of(paper: str) -> list[Any]:
    """Rows of a paper (of all with "") that can be run, with their tables."""
    return [
        pytest.param(table, row, id=f"{name}: {row.label}")
        for name, table in TABLES.items()
        for row in table.rows
        if row.experiment is not None and name.startswith(paper)
    ]


def row_of(name: str, label: str) -> Row:
    (row,) = (row for row in TABLES[name].rows if row.label == label)
    return row


def request(name: str, scale: str = "demo") -> TableRequest:
    return TableRequest("t", TABLES[name], scale, (0,))


def row_config(table: Table, row: Row) -> DictConfig:
    """The configuration of a row at demo size."""
    return OmegaConf.create(dict(row_spec(table, row).plain))


def assert_printed(row: Row, found: dict[str, Any]) -> None:
    """What is found of a row's configuration is what the paper prints about it."""
    printed = {key: value for key, value in row.settings.items() if value is not None}
    shared = set(printed) & set(found)
    assert {key: printed[key] for key in shared} == {key: found[key] for key in shared}


@pytest.mark.parametrize(("table", "row"), rows_of(""))
def test_row_masks_match_printed_settings(table: Table, row: Row) -> None:
    config = row_config(table, row)
    masker, loss = config.masker, config.loss
    assert min(build(masker).grid_hw(tuple(config.transform.crop_hw))) > 1
    found = {
        "patch_size": 2 * (masker.patch_size or 0),  # pixels are halved at demo scale
        "alpha": loss.get("spatial", loss).get("alpha"),
        "beta": loss.get("beta"),
        "focus": loss.get("spatial", {}).get("focus"),
        "masking_ratio": masker.ratio,
        "masking": {"indiv": "irm", "rand_comp": "crm", "comp": "crm_pair"}.get(
            masker.pairing or ""
        ),
    }
    if masker.sigma_div is not None:
        found["sigma_p"] = "Ny" if masker.sigma_div == 1 else f"Ny/{masker.sigma_div:g}"
    assert_printed(row, found)


@pytest.mark.parametrize(("table", "row"), rows_of("temporal"))
def test_temporal_row_has_printed_losses_and_views(table: Table, row: Row) -> None:
    config = row_config(table, row)
    first, second = ["seg1"], []
    if "second" in config.loss:
        first += ["dice1"] if config.loss.alpha else []
        second = ["seg2", *SECOND[config.loss.second]]
        assert bool(config.loss.beta) == (config.loss.second != "none")
        assert config.loss.form == "paper"
    assert (row.settings["losses_img1"], row.settings["losses_img2"]) == (first, second)
    assert row.settings["network"] in config.model["_target_"].lower()
    mode = config.scheme.view.mode if "view" in config.scheme else "neither"
    views = {"rotation": ("rotation", "both"), "translation": ("translation", "both")}
    if table.number == "TABLE II":
        assert_printed(row, {key: mode in modes for key, modes in views.items()})


TWICE = (
    "spatialseg/table3 Ny/4 | spatialseg/table4 PS 64 | spatialseg/table5 alpha 0"
    " | spatialseg/table6 no weighting",
    "spatialseg/table5 alpha 2 | spatialseg/table6 Edge | spatialseg/table7 Ours (Swin-S)",
    "crm/table1 Ours | crm/table2a Ours (Swin-S) | crm/table3a Ours | crm/table3b Patch (32)"
    " | crm/table4 CRM",
    "temporal/table1 (A) | temporal/table2 (A)",
    "temporal/table1 (G) | temporal/table4 Ours-dice",
    "temporal/table1 (H) | temporal/table2 (D) | temporal/table3 (E) | temporal/table4 Ours-con",
    "temporal/table1 (I) | temporal/table4 Ours-con-acc",
    "multihead/table2 HeatNet (reproduced) | multihead/table3 HeatNet*",
    "multihead/table2 HeatNet RGB-only (reproduced) | multihead/table4 HeatNet RGB-only*",
)
MAIN = ("mIoU", "rgbt_mIoU", "mIoU_day", "mIoU_rgb")


@pytest.mark.parametrize("scale", ["demo", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize("cells", TWICE)
def test_rows_printed_twice_are_one_run(cells: str, scale: str) -> None:
    keys, printed = set(), set()
    for name, _, label in (cell.partition(" ") for cell in cells.split(" | ")):
        row = row_of(name, label)
        keys.add(row_spec(TABLES[name], row, scale).key)
        value = next(row.values[key] for key in MAIN if row.values.get(key) is not None)
        assert value is not None
        printed.add(round(value, 1))
    assert (len(keys), len(printed)) == (1, 1)


@pytest.mark.parametrize("number", [3, 4, 5, 6])
def test_printed_variance_is_the_population_variance_of_the_rings(number: int) -> None:
    for row in TABLES[f"spatialseg/table{number}"].rows:
        rings = [row.values[f"IoU{ring}"] for ring in range(1, 6)]
        mean = sum(value for value in rings if value is not None) / 5
        variance = sum((value - mean) ** 2 for value in rings if value is not None) / 5
        printed = row.values["Var"]
        assert printed is not None
        assert (abs(variance - printed) > 0.02) == ("Var" in row.doubtful), (row.label, variance)


@pytest.mark.parametrize("number", [2, 3, 4])
def test_printed_mean_is_that_of_both_columns(number: int) -> None:
    table = TABLES[f"multihead/table{number}"]
    mean = next(column for column in table.columns if column.name == "mean_mIoU")
    for row in table.rows:
        known = [row.values.get(name) for name in (*mean.sources, "mean_mIoU")]
        if None not in known:
            first, second, printed = (value or 0.0 for value in known)
            assert printed == pytest.approx((first + second) / 2, abs=0.0501), row.label
