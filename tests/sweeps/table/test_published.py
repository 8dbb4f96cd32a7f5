"""The printed numbers of our tables against the transcription beside the checkout."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from sweeps.table.load_table import load_table, table_names
from sweeps.table.table import Row

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).resolve().parents[3].parent / "shared"))
FOLDER = SHARED / "published"
PAPERS = ("crm", "multihead", "spatialseg", "temporal")

OURS = {name: load_table(name) for name in table_names(Path("none"))}

pytestmark = pytest.mark.skipif(
    not all((FOLDER / f"{paper}.yaml").is_file() for paper in PAPERS),
    reason="reference material is not here",
)


def one_row_per_cell(table: dict[str, Any]) -> dict[str, Any]:
    """The thesis prints both teachers in one row; each is a run and so a row of ours."""
    words = dict(zip(table["columns"], table["columns_printed"], strict=True))
    whose = {"Ours": "", "Paper": " (HeatNet paper)"}
    rows = [
        {**row, "label": words[column] + whose[row["label"]], "values": {"mIoU": value}}
        for row in table["rows"]
        for column, value in row["values"].items()
    ]
    return {**table, "rows": rows}


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    """Tables that hold numbers, by the name of ours."""
    found: dict[str, Any] = {}
    for paper in PAPERS:
        tables = yaml.safe_load((FOLDER / f"{paper}.yaml").read_text(encoding="utf-8"))["tables"]
        found |= {f"{paper}/{key}": table for key, table in tables.items() if table["rows"]}
    found["multihead/table1"] = one_row_per_cell(found["multihead/table1"])
    return found


def printed_rows(name: str) -> list[Row]:
    """Rows of our table that the paper has; those of ours alone hold no printed value."""
    ours = [row for row in OURS[name].rows if row.origin is None]
    assert not any(row.values for row in ours), name
    return [row for row in OURS[name].rows if row.origin is not None]


def numbers(value: Any) -> Iterator[float | None]:
    """Numbers of a row's values in their order; a cell may hold several."""
    if isinstance(value, dict):
        for child in value.values():
            yield from numbers(child)
    else:
        yield value


def count_and_sum(values: list[float | None]) -> tuple[int, int, float]:
    """Cells, cells with a number, sum of the numbers."""
    known = [value for value in values if value is not None]
    return len(values), len(known), math.fsum(known)


def test_every_table_with_numbers_is_here(published: dict[str, Any]) -> None:
    assert sorted(published) == sorted(OURS)


@pytest.mark.parametrize("name", OURS)
def test_numbers_arrive_unchanged(name: str, published: dict[str, Any]) -> None:
    ours, theirs = printed_rows(name), published[name]["rows"]
    assert [row.label for row in ours] == [row["label"] for row in theirs]
    for row, other in zip(ours, theirs, strict=True):
        expected = list(numbers(other["values"]))
        assert count_and_sum(list(row.values.values())) == count_and_sum(expected), row.label
        assert list(row.values.values()) == expected, row.label
        assert (row.origin, row.proposed) == (other["origin"], other["proposed"]), row.label


def test_columns_are_in_the_printed_order(published: dict[str, Any]) -> None:
    for name, table in published.items():
        ours = OURS[name]
        names = [column.name for column in ours.columns if column.printed]
        flat = [
            f"{key}_{part}" if part else key
            for key, cell in table["rows"][0]["values"].items()
            for part in (cell if isinstance(cell, dict) else [""])
        ]
        assert names == flat, name
