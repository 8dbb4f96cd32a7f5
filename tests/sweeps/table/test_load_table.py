"""Tables as files: what the loader refuses, and what every published file must hold."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest
import yaml

from rgbt.checks import InputError
from sweeps.table.load_table import load_table
from sweeps.table.table import Column, Row, Table

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
    """A difference of a column that follows it."""
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


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"colums": []}, "'colums' is not a key; did you mean 'columns'"),
        (row(overides=["a=1"]), "row 'small': 'overides' is not a key; did you mean 'overrides'"),
        (row(overrides=["a=1"]), "row 'small': the row has no experiment; add one, or remove"),
        (row(origin="own_methode"), "row 'small': 'origin': input should be 'own_method'"),
        (
            row(values={"mIuO": 1}),
            "row 'small', column: 'mIuO' is not a valid choice; did you mean",
        ),
        (
            row(without=["Vra"]),
            "row 'small', without: 'Vra' is not a valid choice; did you mean 'Var'",
        ),
        (row(values={"mIoU": "61"}), "row 'small', values: 'mIoU': input should be a valid number"),
        (row(values={"mIoU": float("nan")}), "'mIoU': input should be a finite number"),
        (row(overrides=[4]), "row 'small': 'overrides[0]': input should be a valid string"),
        (row(experiment="grmb"), "experiment: 'grmb' is not a valid choice; did you mean 'grbm'"),
        (row(at={"papr": ["a=1"]}), "row 'small', at: 'papr' is not a valid choice; did you mean"),
        (row(x=0), "'x' must be > 0 on a log axis, got 0"),
        ({**row(x=1), "factor": None}, "'x' has no effect without the table's 'factor'"),
        ({"rows": [{"experiment": "grbm"}]}, "row 1: 'label' has no value"),
        ({"rows": [{"label": "a"}, {"label": "a"}]}, "rows: 'a' is used twice"),
        ({"rows": ["a"]}, "'rows[0]': input should be an object"),
        ({"at": {"big": []}}, "at: 'big' is not a valid choice; known: bench, demo, paper"),
        ({"regions": "ring7"}, "regions: 'ring7' is not a valid choice"),
        ({"absent": "exlude"}, "'absent': input should be 'released' or 'exclude'"),
        (column(metric="Var", name="mIoU"), "columns: 'mIoU' is used twice"),
        (column(metric="Var", best="low"), "column 'b': 'best': input should be 'highest'"),
        (column(), "expected one of metric, minus, mean and efficiency, got none"),
        (column(metric="Var", efficiency="latency"), "got metric and efficiency"),
        (column(minus=["mIoU"]), "column 'b': 'minus[1]' has no value"),
        (column(minus=["mIoU", "IoU"]), "column 'b', minus: 'IoU' is not a valid choice"),
        (column(mean=["mIoU", "IoU"]), "column 'b', mean: 'IoU' is not a valid choice"),
        (column(mean=["mIoU", "mIoU"]), "two or more different columns, got mIoU, mIoU."),
        (column(mean=["mIoU", "b"]), "'b' is computed from other columns itself; move it in front"),
        (behind(efficiency="parameters"), "minus: 'c' is the efficiency of networks and no score"),
        (behind(mean=["mIoU", "b"]), "minus: 'c' is computed from other columns itself; move it"),
        (column(metric="Var", head="target "), "'head': input should be 'as trained', 'own'"),
        (column(mean=["mIoU", "b"], head="source"), "'head' is only for scores of single frames"),
        (column(metric="TC", frames="aligned", head="target"), "remove head: target"),
        (
            column(metric="Var", corruption="nois"),
            "corruption: 'nois' is not a valid choice; did you",
        ),
        (column(metric="Var", corruption="noise"), "needs a severity (grey levels (std)); one of"),
        (column(metric="Var", corruption="noise", severity=300), "'b': severity (standard dev"),
        (column(metric="Var", severity=8), "'severity' needs a corruption; add corruption"),
        (
            column(efficiency="latency", corruption="removed:rgb"),
            "only for scores of single frames; remove",
        ),
        (column(metric="TC", frames="aligned", corruption="removed:rgb"), "remove corruption: re"),
        (column(mean=["mIoU", "b"], batch_norm="adabn"), "single frames; remove batch_norm: adabn"),
        (
            column(metric="Var", batch_norm_splits=["val"]),
            "'batch_norm_splits' needs batch_norm: a",
        ),
        (
            column(metric="distance/0-15"),
            "distance: '0-15' is not a valid choice; did you mean '0-10",
        ),
        (column(metric="night/region/1/size/0-65"), "'0-65' is not a valid choice; did you mean"),
        ({**column(metric="class/{kind}"), **row()}, "'kind' of metric class/{kind}"),
        (column(metric="TC"), "TC compares two frames; add frames: aligned, released or next"),
        (column(metric="Var", frames="aligned"), "'frames' is only for TC, CA, CA_released"),
        (column(metric="TC", frames="aligned", modality="thermal"), "remove modality: thermal"),
        ({**column(metric="Var", printed=False), **row(values={"b": 3})}, "'b' is not printed"),
        ({**column(metric="Var", printed=False), **row(doubtful=["b"])}, "'b' is not printed"),
    ],
)
def test_refuses(tmp_path: Path, changes: dict[str, Any], sentence: str) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(InputError) as raised:
        load_table("my/ablation", tmp_path)
    assert sentence in str(raised.value)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_unknown_name_gets_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'spatialseg/table3'"):
        load_table("spatialseg/tabel3", tmp_path)
    with pytest.raises(InputError, match="there is no such file"):
        load_table(str(tmp_path / "none.yaml"))


def test_user_table_does_not_hide_a_published_one(tmp_path: Path) -> None:
    (tmp_path / "crm").mkdir()
    write(tmp_path).rename(tmp_path / "crm" / "table4.yaml")
    with pytest.raises(InputError, match="is both"):
        load_table("crm/table4", tmp_path)


def test_table_overrides_precede_row_overrides() -> None:
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


def test_columns_of_row_omit_dependent_columns() -> None:
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
