"""Tables as files: what the loader refuses, and what every published file must hold."""

from __future__ import annotations

from dataclasses import FrozenInstanceError
from pathlib import Path
from typing import Any

import pytest
import yaml

from rgbt.checks import InputError
from sweeps.plan.table import STUDIES, Column, Row, Table, load_table

pytestmark = pytest.mark.usefixtures("own_folder")

SMALL: dict[str, Any] = {
    "paper": "my",
    "number": "1",
    "caption": "Cells of two sizes.",
    "data": "nothing yet",
    "columns": [{"name": "mIoU", "metric": "mIoU"}, {"name": "Var", "metric": "Var"}],
    "rows": [
        {"label": "small", "experiment": "grbm", "overrides": ["masker.sigma_div=1"]},
        {"label": "large", "settings": {"kind": "a"}, "values": {"mIoU": 61, "Var": None}},
    ],
}


@pytest.fixture
def own_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sweeps.plan.table.OWN", tmp_path)


def write(folder: Path, **changes: Any) -> Path:
    path = folder / "my" / "ablation.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return path


def row(**keys: Any) -> dict[str, Any]:
    return {"rows": [{"label": "small", **keys}]}


def column(**keys: Any) -> dict[str, Any]:
    return {"columns": [{"name": "mIoU", "metric": "mIoU"}, {"name": "b", **keys}]}


def behind(**keys: Any) -> dict[str, Any]:
    """A difference of a column that follows it."""
    columns = column(minus=["mIoU", "c"])["columns"]
    return {"columns": [*columns, {"name": "c", **keys}]}


def test_own_table_needs_no_printed_values(tmp_path: Path) -> None:
    write(tmp_path, number=1)
    table = load_table("my/ablation")
    assert table.number == "1"
    assert [row.label for row in table.rows] == ["small", "large"]
    assert (table.unit, table.regions, table.absent) == ("percent", "as trained", None)
    assert table.columns[1].best == "highest"
    assert table.rows[0].values == {}
    assert table.rows[0].overrides == ("masker.sigma_div=1",)
    assert table.rows[1].values == {"mIoU": 61.0, "Var": None}
    with pytest.raises(FrozenInstanceError):
        table.rows[0].label = "other"  # type: ignore[misc]


ONE_CLAIM = {
    "name": "c",
    "says": "",
    "source": "",
    "rows": ["small"],
    "against": ["large"],
    "columns": ["mIoU"],
    "expected": "higher",
}


def claim(**keys: Any) -> dict[str, Any]:
    return {"claims": [{**ONE_CLAIM, **keys}]}


@pytest.mark.parametrize(
    ("changes", "key"),
    [
        ({"colums": []}, "colums"),
        ({"rows": []}, "rows"),
        (row(overides=["a=1"]), r"rows\[0\].overides"),
        (row(overrides=["a=1"]), r"rows\[0\].*experiment"),
        (row(values={"mIuO": 1}), "'mIuO'.*did you mean 'mIoU'"),
        (row(without=["Vra"]), "without: 'Vra'"),
        (row(values={"mIoU": float("nan")}), "finite"),
        (row(experiment="grmb"), "experiment: 'grmb'.*did you mean 'grbm'"),
        (row(at={"papr": ["a=1"]}), "at: 'papr'"),
        (row(same_as="large"), "same_as"),
        ({"rows": [{"label": "a"}, {"label": "a"}]}, "'a' is used twice"),
        ({"at": {"big": []}}, "at: 'big'"),
        ({"folds": {"big": "mfnet200"}}, "folds: 'big'"),
        ({"folds": {"real": "mfnet"}}, "folds: 'mfnet_fold0'"),
        ({"blocks": {"real": 0}}, "blocks"),
        (column(metric="Var", name="mIoU"), "'mIoU' is used twice"),
        (column(metric="mIou"), "did you mean 'mIoU'"),
        (column(), r"columns\[1\].*metric"),
        (column(minus=["mIoU", "IoU"]), "'IoU'"),
        (column(mean=["mIoU", "b"]), "column 'b': 'b'"),
        (behind(efficiency="parameters"), "column 'b': 'c'"),
        (column(mean=["mIoU", "mIoU"], head="source"), "'head'"),
        (column(metric="TC", frames="aligned", corruption="noise"), "'corruption'"),
        (column(metric="Var", frames="aligned"), "'frames'"),
        (column(metric="class/{kind}"), "'kind'"),
        ({**column(metric="Var", printed=False), **row(values={"b": 3})}, "'b'"),
        (claim(rows=["smal"]), "'smal'.*did you mean 'small'"),
        (claim(columns=["acc"]), "columns: 'acc'"),
        (claim(against=["small"]), "nothing to compare"),
        (claim(expected="similar"), "at_most"),
        (claim(at_least=2, at_most=1), "at_most"),
    ],
)
def test_table_that_does_not_fit_is_refused(
    tmp_path: Path, changes: dict[str, Any], key: str
) -> None:
    path = write(tmp_path, **changes)
    with pytest.raises(InputError, match=key) as raised:
        load_table("my/ablation")
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_claim_about_a_part_that_its_design_lacks_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bias.yaml"
    known = (STUDIES / "spatial_bias.yaml").read_text()
    path.write_text(known.replace("part: trained", "part: trainde"))
    with pytest.raises(InputError, match="part: 'trainde'.*did you mean 'trained'"):
        load_table(str(path))


def test_unknown_name_gets_the_nearest(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'spatialseg/table3'"):
        load_table("spatialseg/tabel3")
    with pytest.raises(InputError, match="none.yaml"):
        load_table(str(tmp_path / "none.yaml"))


def test_user_table_does_not_hide_a_published_one(tmp_path: Path) -> None:
    (tmp_path / "crm").mkdir()
    write(tmp_path).rename(tmp_path / "crm" / "table4.yaml")
    with pytest.raises(InputError, match="is both"):
        load_table("crm/table4")


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
        Column(name="day", metric="day/mIoU"),
        Column(name="night", metric="night/mIoU"),
        Column(name="both", mean=("day", "night")),
        Column(name="far", mean=("both", "day")),
    )
    table = Table(paper="", number="", caption="", data="", columns=columns, rows=(row,))
    assert [column.name for column in table.columns_of(row)] == ["day"]
    assert table.columns_of(Row(label="b")) == columns
