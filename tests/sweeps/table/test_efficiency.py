"""Efficiency of the rows' networks, without any run."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pandas as pd
import pytest

from rgbt.evaluation import profile
from sweeps.table.efficiency import efficiency_cells
from sweeps.table.request import TableRequest
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import table

SIZE = Column(name="size", efficiency="parameters")
MFNET = 736_275
"""As its authors count it, at nine classes."""


FOURTEEN = MFNET + 5 * (9 * 32 + 1 + 2)
"""With fourteen classes: convolutions of 3 x 3 with bias, and the batch normalisation behind."""


def wanted(*rows: Row, columns: tuple[Column, ...] = (SIZE,), **others: Any) -> TableRequest:
    return TableRequest("own/t", table(rows, columns, **others), "demo", (0, 1))


def test_parameter_cells_use_paper_scale() -> None:
    row = Row(label="a", experiment="crm", at={"paper": ("model=mfnet",)})
    cell = efficiency_cells(wanted(row))["a", "size"]
    assert cell.mean * 1e6 == pytest.approx(MFNET)
    assert (cell.seeds, cell.keys, cell.reason, math.isnan(cell.sd)) == (0, (), "", True)


def test_parameter_cells_follow_overrides_and_report_errors() -> None:
    rows = (ROWS[0], replace(ROWS[3], label="b"))
    asked = TableRequest("own/t", table(rows, (SIZE,)), "demo", (0,), ("model.num_classes=14",))
    cells = efficiency_cells(asked)
    assert cells["a", "size"].mean * 1e6 == pytest.approx(FOURTEEN)
    assert cells["b", "size"].mark == "no value"
    assert "there is no model 'mfnte'; did you mean 'mfnet" in cells["b", "size"].reason


ALL = (
    SIZE,
    Column(name="flops", efficiency="gflops"),
    Column(name="memory", efficiency="peak_memory"),
    Column(name="ms", efficiency="latency"),
    Column(name="fps", efficiency="images_per_second"),
)
ROWS = (
    Row(label="a", experiment="crm", overrides=("model=mfnet",)),
    Row(label="as a", experiment="crm", overrides=("model=mfnet",)),
    Row(
        label="b",
        experiment="crm",
        overrides=("model=mfnet",),
        settings={"image_hw": [512, 640]},
    ),
    Row(label="wrong", experiment="crm", overrides=("model=mfnte",)),
    Row(label="theirs", values={"fps": 3.0}),
)


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, Any]]:
    """The calls of the profile; the second network is slower and larger."""
    called: list[tuple[Any, Any]] = []

    def fake(networks: Sequence[Any], settings: Any) -> SimpleNamespace:
        called.append((networks, settings))
        rows = []
        for number, network in enumerate(networks, start=1):
            times = {"latency_ms": 100.0 * number, "images_per_second": 10.0 / number}
            values = {"peak_memory": 2**20 * number, "ratio": 1 + 1.1 * (number - 1), **times}
            values = values if settings.measure else dict.fromkeys(values)
            rows.append({"name": network.name, "flops": number * 10**9, **values})
        setup = {"device": "cpu", "threads": 2, "torch": "2"}
        return SimpleNamespace(setup=setup, networks=pd.DataFrame(rows))

    monkeypatch.setattr(profile, "profile", fake)
    return called


def test_all_networks_are_measured_in_one_call(calls: list[tuple[Any, Any]]) -> None:
    cells = efficiency_cells(wanted(*ROWS, columns=ALL))
    ((networks, settings),) = calls
    assert settings.measure
    words = ("+experiment=crm", "scale=paper", "model=mfnet")
    assert [(each.name, each.overrides, each.image_hw) for each in networks] == [
        ("a", words, (480, 640)),
        ("b", words, (512, 640)),
    ]
    b = {column.name: cells["b", column.name] for column in ALL}
    means = {name: cell.mean for name, cell in b.items() if name != "size"}
    assert means == {"flops": 2.0, "memory": 2.0, "ms": 200.0, "fps": 5.0}
    ratios = {name: cell.ratio for name, cell in b.items()}
    assert ratios == pytest.approx(
        {"size": math.nan, "flops": math.nan, "memory": 2.0, "ms": 2.1, "fps": 1 / 2.1},
        nan_ok=True,
    )
    assert cells["as a", "ms"] == cells["a", "ms"]
    assert b["fps"].device == "cpu, 2 threads, torch 2"
    assert "did you mean 'mfnet" in cells["wrong", "fps"].reason
    assert not [label for label, _ in cells if label == "theirs"]


def test_counted_columns_measure_nothing(calls: list[tuple[Any, Any]]) -> None:
    cells = efficiency_cells(wanted(*ROWS[:3], columns=ALL[:2]))
    assert [settings.measure for _, settings in calls] == [False]
    assert (cells["b", "flops"].mean, cells["b", "flops"].device) == (2.0, "")
    efficiency_cells(wanted(*ROWS[:3], columns=ALL[:1]))
    assert len(calls) == 1


def test_failed_profile_is_the_reason_of_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(profile, "profile", Mock(side_effect=RuntimeError("no memory")))
    cells = efficiency_cells(wanted(*ROWS[:1], columns=ALL))
    assert (cells["a", "fps"].reason, cells["a", "fps"].mark) == ("no memory", "no value")
    assert cells["a", "size"].mean * 1e6 == pytest.approx(MFNET)


@pytest.mark.slow
def test_gflops_are_those_of_the_command() -> None:
    row = Row(label="a", experiment="crm", overrides=("model=mfnet",))
    cells = efficiency_cells(wanted(replace(row, settings={"image_hw": [48, 64]}), columns=ALL[:2]))
    # All operations of MFNet are convolutions, so they grow with the image: 16.59 at 480 x 640.
    assert cells["a", "flops"].mean == pytest.approx(0.1659, abs=1e-4)
