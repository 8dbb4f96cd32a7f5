"""Tables as files: what the loader refuses, and what every published file must hold."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest
import yaml

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.metrics.named import parse
from rgbt.spec.specify import specify
from sweeps.table.table import Column, Row, Table, load_table, table_names
from tests.sweeps.composed import row_config

TABLES = {name: load_table(name) for name in table_names(Path("none"))}
ROWS = [
    pytest.param(table, row, id=f"{name}: {row.label}")
    for name, table in TABLES.items()
    for row in table.rows
    if row.experiment is not None
]
SMALL: dict[str, Any] = {
    "paper": "my",
    "number": "1",
    "caption": "Cells of two sizes.",
    "data": "nothing yet",
    "columns": [{"name": "mIoU", "metric": "mIoU"}, {"name": "Var", "metric": "Var"}],
    "factor": {"name": "size", "axis": "log"},
    "rows": [
        {"label": "small", "experiment": "grbm", "overrides": ["masker.sigma_div=1"], "x": 1},
        {"label": "large", "settings": {"kind": "a"}, "values": {"mIoU": 61, "Var": None}},
    ],
}


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "my" / "ablation.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return path


def row(**keys: Any) -> dict[str, Any]:
    return {"rows": [{"label": "small", **keys}]}


def column(**keys: Any) -> dict[str, Any]:
    return {"columns": [{"name": "mIoU", "metric": "mIoU"}, {"name": "b", **keys}], "rows": []}


def behind(**keys: Any) -> dict[str, Any]:
    """A difference of a column that stands behind it."""
    columns = column(minus=["mIoU", "c"])["columns"]
    return {"columns": [*columns, {"name": "c", **keys}], "rows": []}


def test_own_table_needs_no_printed_values(tmp_path: Path) -> None:
    write(tmp_path)
    table = load_table("my/ablation", tmp_path)
    assert [row.label for row in table.rows] == ["small", "large"]
    assert (table.unit, table.regions, table.absent) == ("percent", "as trained", None)
    assert table.columns[1].best == "highest"
    assert table.rows[0].values == {}
    assert table.rows[0].overrides == ("masker.sigma_div=1",)
    assert table.rows[1].values == {"mIoU": 61.0, "Var": None}
    with pytest.raises(FrozenInstanceError):
        table.rows[0].label = "other"  # type: ignore[misc]


def test_path_and_name_find_the_same_table(tmp_path: Path) -> None:
    path = write(tmp_path)
    assert load_table(str(path)) == load_table("my/ablation", tmp_path)


def test_names_list_published_tables_and_ones_own(tmp_path: Path) -> None:
    write(tmp_path)
    names = table_names(tmp_path)
    assert names[-1] == "my/ablation"
    assert {"crm/table2a", "spatialseg/fps", "temporal/table5", "multihead/table1"} < set(names)
    assert len(names) == 26


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"colums": []}, "'colums' is not a key; did you mean 'columns'"),
        (row(overides=["a=1"]), "row 'small': 'overides' is not a key; did you mean 'overrides'"),
        (row(origin="own_methode"), "row 'small': 'origin': input should be 'own_method'"),
        (row(values={"mIuO": 1}), "row 'small', column: 'mIuO' is not a choice; did you mean"),
        (row(without=["Vra"]), "row 'small', without: 'Vra' is not a choice; did you mean 'Var'"),
        (row(doubtful=["IoU"]), "row 'small', column: 'IoU' is not a choice"),
        (row(values={"mIoU": "61"}), "row 'small', values: 'mIoU': input should be a valid number"),
        (row(values={"mIoU": float("nan")}), "'mIoU': input should be a finite number"),
        (row(overrides=[4]), "row 'small': 'overrides[0]': input should be a valid string"),
        (row(overrides="a=1"), "row 'small': 'overrides': input should be a list"),
        (row(experiment="grmb"), "experiment: 'grmb' is not a choice; did you mean 'grbm'"),
        (row(at={"papr": ["a=1"]}), "row 'small', at: 'papr' is not a choice; did you mean"),
        (row(x=0), "'x' must be > 0 on a log axis, got 0"),
        ({**row(x=1), "factor": None}, "'x' has no effect without 'factor'"),
        ({"rows": [{"experiment": "grbm"}]}, "row 1: 'label' has no value"),
        ({"rows": [{"label": "a"}, {"label": "a"}]}, "rows: 'a' stands twice"),
        ({"rows": ["a"]}, "'rows[0]': input should be an object"),
        ({"rows": {"label": "a"}}, "'rows': input should be a list"),
        ({"at": {"big": []}}, "at: 'big' is not a choice; known: demo, paper"),
        ({"regions": "ring7"}, "regions: 'ring7' is not a choice"),
        ({"absent": "exlude"}, "'absent': input should be 'released' or 'exclude'"),
        (column(metric="Var", name="mIoU"), "columns: 'mIoU' stands twice"),
        (column(metric="Var", best="low"), "column 'b': 'best': input should be 'highest'"),
        (column(), "expected one of metric, minus, mean, parameters and needs, got none"),
        (column(metric="Var", needs="a part"), "got metric and needs"),
        (column(minus=["mIoU"]), "column 'b': 'minus[1]' has no value"),
        (column(minus=["mIoU", "IoU"]), "column 'b', minus: 'IoU' is not a choice"),
        (column(mean=["mIoU", "IoU"]), "column 'b', mean: 'IoU' is not a choice"),
        (column(mean=[]), "column 'b', mean: expected two or more different columns, got none"),
        (column(mean=["mIoU"]), "expected two or more different columns, got mIoU."),
        (column(mean=["mIoU", "mIoU"]), "two or more different columns, got mIoU, mIoU."),
        (column(mean=["mIoU", "b"]), "'b' is computed from other columns itself; move it in front"),
        (column(mean="mIoU"), "column 'b': 'mean': input should be a list"),
        (column(metric="Var", parameters=True), "got metric and parameters"),
        (column(parameters="yes"), "column 'b': 'parameters': input should be a valid bool"),
        (behind(parameters=True), "minus: 'c' counts parameters and is no score"),
        (behind(mean=["mIoU", "b"]), "minus: 'c' is computed from other columns itself; move it"),
        (column(metric="Var", head="target "), "'head': input should be 'as trained', 'own'"),
        (column(mean=["mIoU", "b"], head="source"), "'head' is for scores of single frames alone"),
        (column(parameters=True, head="source"), "single frames alone; remove head: source"),
        (column(metric="TC", frames="aligned", head="target"), "remove head: target"),
        (column(metric="Var", degradation="nois"), "degradation: 'nois' is not a choice; did you"),
        (column(metric="Var", degradation="noise"), "needs a severity (grey levels (std)); one of"),
        (
            column(metric="Var", degradation="noise", severity=300),
            "column 'b': severity (standard deviation in grey levels) must lie in [0, 255], got",
        ),
        (column(metric="Var", degradation="noise", severity="8"), "'severity': input should be a"),
        (column(metric="Var", severity=8), "'severity' is of a degradation; add degradation"),
        (column(needs="x", degradation="rgb_removed"), "for scores of single frames alone; remove"),
        (
            column(metric="TC", frames="aligned", degradation="rgb_removed"),
            "single frames alone; remove degradation: rgb_removed",
        ),
        ({**column(metric="class/{kind}"), **row()}, "'kind' of metric class/{kind}"),
        (column(metric="TC"), "TC compares two frames; add frames: aligned, released or next"),
        (column(metric="class/car/CA"), "class/car/CA compares two frames"),
        (column(metric="TC", frames="align"), "'frames': input should be 'aligned', 'released'"),
        (column(metric="Var", frames="aligned"), "'frames' is for TC, CA, CA_released alone"),
        (column(minus=["b", "mIoU"], frames="aligned"), "'frames' is for TC, CA, CA_released"),
        (
            column(metric="TC", frames="aligned", modality="thermal"),
            "column 'b': consistency is counted from what the network is made for; remove modality",
        ),
        (
            {**column(metric="Var", printed=False), **row(values={"b": 3})},
            "row 'small': column 'b' is not printed (printed: false); remove its value",
        ),
        (
            {**column(metric="Var", printed=False), **row(doubtful=["b"])},
            "column 'b' is not printed",
        ),
        (column(metric="Var", printed="no"), "column 'b': 'printed': input should be a valid bool"),
    ],
)
def test_refuses(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(InputError) as raised:
        load_table("my/ablation", tmp_path)
    assert sentence in str(raised.value)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("paper: my\npaper: yours\n", "duplicate key"),
        ("rows: [", "cannot be read as YAML"),
        ("- a\n", "the whole file"),
    ],
)
def test_refuses_what_is_no_table(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "broken.yaml").write_text(text)
    with pytest.raises(InputError, match=sentence):
        load_table("broken", tmp_path)


def test_unknown_name_gets_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'spatialseg/table3'"):
        load_table("spatialseg/tabel3", tmp_path)
    with pytest.raises(InputError, match="there is no such file"):
        load_table(str(tmp_path / "none.yaml"))


def test_ones_own_table_does_not_hide_a_published_one(tmp_path: Path) -> None:
    (tmp_path / "crm").mkdir()
    write(tmp_path).rename(tmp_path / "crm" / "table4.yaml")
    with pytest.raises(InputError, match="as well as"):
        load_table("crm/table4", tmp_path)


def test_overrides_go_from_the_table_to_the_row_at_its_scale() -> None:
    row = Row(label="a", experiment="crm", overrides=("b=2",), at={"paper": ("c=3",)})
    table = Table(
        paper="my",
        number="1",
        caption="",
        data="",
        columns=(),
        rows=(row, Row(label="printed")),
        at={"paper": ("a=1",)},
    )
    assert table.overrides(row, "paper") == ("+experiment=crm", "a=1", "b=2", "c=3")
    assert table.overrides(row, "demo") == ("+experiment=crm", "b=2")
    with pytest.raises(InputError, match="row 'printed' has no experiment"):
        table.overrides(table.rows[1], "demo")


def test_a_row_runs_unless_a_part_is_missing() -> None:
    def runnable(row_needs: str | None, table_needs: str | None, experiment: str | None) -> bool:
        row = Row(label="a", experiment=experiment, needs=row_needs)
        table = Table(
            paper="", number="", caption="", data="", columns=(), rows=(row,), needs=table_needs
        )
        return table.runnable(row)

    assert runnable(None, None, "crm")
    assert not runnable("a part", None, "crm")
    assert not runnable(None, "a part", "crm")
    assert not runnable(None, None, None)


def test_a_row_leaves_out_columns_and_what_is_computed_from_them() -> None:
    row = Row(label="a", experiment="crm", without=("night",))
    columns = (
        Column(name="far", mean=("both", "day")),
        Column(name="day", metric="day/mIoU"),
        Column(name="night", metric="night/mIoU"),
        Column(name="both", mean=("day", "night")),
    )
    table = Table(paper="", number="", caption="", data="", columns=columns, rows=(row,))
    assert [column.name for column in table.columns_of(row)] == ["day"]
    assert table.columns_of(Row(label="b")) == columns


@pytest.mark.parametrize(("table", "row"), ROWS)
def test_published_row_composes_and_its_masks_fit(table: Table, row: Row) -> None:
    config = row_config(table, row, "demo")
    grid = build(config.masker).grid_hw(tuple(config.transform.crop_hw))
    assert min(grid) > 1


@pytest.mark.parametrize("scale", ["demo", pytest.param("paper", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "cells",
    [
        [
            ("spatialseg/table3", "Ny/4"),
            ("spatialseg/table4", "PS 64"),
            ("spatialseg/table5", "alpha 0"),
            ("spatialseg/table6", "no weighting"),
        ],
        [
            ("spatialseg/table5", "alpha 2"),
            ("spatialseg/table6", "Edge"),
            ("spatialseg/table7", "Ours (Swin-S)"),
        ],
        [
            ("crm/table1", "Ours"),
            ("crm/table2a", "Ours (Swin-S)"),
            ("crm/table3a", "Ours"),
            ("crm/table3b", "Patch (32)"),
            ("crm/table4", "CRM"),
        ],
        [("temporal/table1", "(A)"), ("temporal/table2", "(A)")],
        [("temporal/table1", "(G)"), ("temporal/table4", "Ours-dice")],
        [
            ("temporal/table1", "(H)"),
            ("temporal/table2", "(D)"),
            ("temporal/table3", "(E)"),
            ("temporal/table4", "Ours-con"),
        ],
        [("temporal/table1", "(I)"), ("temporal/table4", "Ours-con-acc")],
    ],
)
def test_rows_that_are_printed_twice_are_one_run(cells: list[tuple[str, str]], scale: str) -> None:
    keys, printed = set(), set()
    for name, label in cells:
        (row,) = [row for row in TABLES[name].rows if row.label == label]
        keys.add(specify(row_config(TABLES[name], row, scale)).key)
        miou = row.values.get("mIoU", row.values.get("rgbt_mIoU"))
        assert miou is not None
        printed.add(round(miou, 1))
    assert len(keys) == 1
    assert len(printed) == 1


@pytest.mark.parametrize(
    "name",
    ["crm/table3a", "crm/table3b", "crm/table4"]
    + [f"spatialseg/table{number}" for number in (3, 4, 5, 6)]
    + [f"temporal/table{number}" for number in (1, 2, 3)],
)
def test_rows_of_an_ablation_are_different_runs(name: str) -> None:
    table = TABLES[name]
    keys = {specify(row_config(table, row, "demo")).key for row in table.rows}
    assert len(keys) == len(table.rows)


@pytest.mark.parametrize(("table", "row"), ROWS)
def test_settings_say_what_the_overrides_do(table: Table, row: Row) -> None:
    masker, loss = (row_config(table, row, "demo")[node] for node in ("masker", "loss"))
    printed = {key: value for key, value in row.settings.items() if value is not None}
    found = {
        "patch_size": 2 * (masker.patch_size or 0),  # pixels are halved at demo scale
        "alpha": loss.get("spatial", loss).get("alpha"),
        "beta": loss.get("beta"),
        "focus": loss.get("spatial", {}).get("focus"),
        "masking_ratio": masker.ratio,
        "masking": {"indiv": "irm", "rand_comp": "crm"}.get(masker.pairing or ""),
    }
    if masker.sigma_div is not None:
        found["sigma_p"] = "Ny" if masker.sigma_div == 1 else f"Ny/{masker.sigma_div:g}"
    shared = set(printed) & set(found)
    assert {key: printed[key] for key in shared} == {key: found[key] for key in shared}


@pytest.mark.parametrize("name", ["crm/table3b", "crm/table4", "spatialseg/table4"])
def test_x_is_the_printed_factor(name: str) -> None:
    key = "masking_ratio" if name == "crm/table4" else "patch_size"
    assert [row.x for row in TABLES[name].rows] == [row.settings[key] for row in TABLES[name].rows]


def test_x_of_the_gaussian_is_its_share_of_the_rows() -> None:
    shares: dict[str | None, float | None]
    shares = {"Ny" if n == 1 else f"Ny/{n}": 1 / n for n in (1, 2, 4, 8, 16, 32)}
    found = {row.settings["sigma_p"]: row.x for row in TABLES["spatialseg/table3"].rows}
    assert found == shares | {None: None}


@pytest.mark.parametrize("name", TABLES)
def test_columns_are_scores_that_can_be_computed(name: str) -> None:
    for row in TABLES[name].rows:
        for column in TABLES[name].columns:
            if column.metric is not None:
                parse(column.metric.format_map(row.settings))


def test_crm_table1_drops_images_of_all_and_features_of_its_own_network() -> None:
    found = TABLES["crm/table1"]
    dropped = {
        column.name: (column.degradation, column.modality)
        for column in found.columns
        if column.metric is not None
    }
    assert dropped == {
        "rgbt_mIoU": (None, "default"),
        "rgb_drop_mIoU": ("rgb_removed", "default"),
        "thr_drop_mIoU": ("thermal_removed", "default"),
        "rgb_drop_features_mIoU": (None, "thermal"),
        "thr_drop_features_mIoU": (None, "rgb"),
    }
    assert all(found.runnable(row) for row in found.rows)
    columns = {row.label: len(found.columns_of(row)) for row in found.rows}
    assert columns == {"RTFNet": 5, "CMXNet": 5, "Ours": 9}


def test_imported_rows_are_published_only() -> None:
    for table in TABLES.values():
        for row in table.rows:
            imported = row.origin in ("imported", "imported_inferred", "mixed")
            assert not (imported and row.experiment)


def test_a_row_of_the_paper_runs_or_says_what_is_missing() -> None:
    silent = [
        (name, row.label)
        for name, table in TABLES.items()
        for row in table.rows
        if (row.origin or "").startswith("own")
        and not (table.runnable(row) or row.needs or table.needs)
    ]
    assert silent == []


@pytest.mark.parametrize("number", [3, 4, 5, 6])
def test_printed_variance_is_the_population_variance_of_the_rings(number: int) -> None:
    for row in TABLES[f"spatialseg/table{number}"].rows:
        rings = [row.values[f"IoU{ring}"] for ring in range(1, 6)]
        mean = sum(value for value in rings if value is not None) / 5
        variance = sum((value - mean) ** 2 for value in rings if value is not None) / 5
        printed = row.values["Var"]
        assert printed is not None
        assert (abs(variance - printed) > 0.02) == ("Var" in row.doubtful), (row.label, variance)


def test_doubtful_cells_are_explained() -> None:
    doubtful = [row for table in TABLES.values() for row in table.rows if row.doubtful]
    assert len(doubtful) == 11
    assert all(row.remarks for row in doubtful)
