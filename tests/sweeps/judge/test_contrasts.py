from __future__ import annotations

import pytest

from sweeps.judge.contrasts import (
    Contrast,
    base_scores,
    contrasts_of,
    difference,
    printed_values,
)
from sweeps.plan.claim import Claim
from sweeps.plan.table import Column, Row
from tests.sweeps.tabled import table

COLUMNS = (
    Column(name="inner", metric="region/1"),
    Column(name="outer", metric="region/2"),
    Column(name="gap", minus=("inner", "outer")),
    Column(name="mean", mean=("inner", "outer")),
    Column(name="twice", minus=("gap", "mean")),
)
ROWS = (
    Row(label="a", experiment="crm", values={"inner": 10.0, "outer": 30.0}),
    Row(label="b", experiment="crm", values={"inner": 15.0, "outer": 31.0}),
    Row(label="c", values={"inner": 12.0, "outer": None}),
    Row(label="d"),
)
TABLE = table(ROWS, COLUMNS)


def claim(**others: object) -> Claim:
    given = {"name": "c", "says": "", "source": "", "rows": ("b",), "columns": ("inner",)}
    return Claim(**{**given, "expected": "higher", **others})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("others", "labels"),
    [
        ({"against": ("a",)}, ["b - a, inner"]),
        ({"against": ("others",)}, ["b - a, inner", "b - c, inner"]),
        ({"rows": ("a", "b", "c"), "against": ("previous",)}, ["b - a, inner", "c - b, inner"]),
        ({"columns": ("inner", "outer")}, ["b, inner", "b, outer"]),
        ({"against": ("a",), "minus_column": "outer"}, ["b - a, inner - outer"]),
    ],
)
def test_contrasts_of_a_claim(others: dict[str, object], labels: list[str]) -> None:
    assert [contrast.label for contrast in contrasts_of(claim(**others), TABLE)] == labels


@pytest.mark.parametrize(
    ("contrast", "value"),
    [
        (difference("b", "a", "inner"), 5.0),
        (difference("b", "a", "inner", "outer"), 5.0 - 1.0),
        (difference("c", "a", "outer"), None),
    ],
)
def test_printed_value_of_a_contrast(contrast: Contrast, value: float | None) -> None:
    assert contrast.of_values(printed_values(TABLE)) == value


def test_derived_columns_are_sums_of_scores() -> None:
    """twice = (inner - outer) - (inner + outer) / 2."""
    weights: dict[str, float] = {}
    for weight, column in base_scores(TABLE, ROWS[0], "twice"):
        weights[column.name] = weights.get(column.name, 0.0) + weight
    assert weights == {"inner": 0.5, "outer": -1.5}
    assert [column.name for _, column in base_scores(TABLE, ROWS[0], "outer")] == ["outer"]


@pytest.mark.parametrize(
    ("others", "wanted"),
    [
        ({}, (0.0, float("inf"))),
        ({"at_least": 2.0, "at_most": 3.0}, (2.0, 3.0)),
        ({"expected": "lower", "at_least": 2.0}, (-float("inf"), -2.0)),
        ({"expected": "lower", "at_most": 2.0}, (-2.0, -0.0)),
        ({"expected": "similar", "at_most": 0.5}, (-0.5, 0.5)),
    ],
)
def test_range_of_a_claim(others: dict[str, object], wanted: tuple[float, float]) -> None:
    assert claim(**others).range == wanted
