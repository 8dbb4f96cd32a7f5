"""Sizes of the rows' networks, without any run."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from sweeps.plan.request import TableRequest
from sweeps.plan.table import Column, Row
from sweeps.score.efficiency import network_sizes
from tests.sweeps.tabled import table

COLUMNS = (Column(name="size", efficiency="parameters"), Column(name="fps", efficiency="speed"))
MFNET = 736_275
"""As its authors count it, at nine classes."""

FOURTEEN = MFNET + 5 * (9 * 32 + 1 + 2)
"""With fourteen classes: convolutions of 3 x 3 with bias, and the batch normalisation behind."""


def test_sizes_are_those_of_paper_scale_and_errors_are_reasons() -> None:
    rows = (
        Row(label="a", experiment="crm", at={"paper": ("model=mfnet",)}),
        Row(label="wrong", experiment="crm", overrides=("model=mfnte",)),
        Row(label="theirs", values={"fps": 3.0}),
    )
    request = TableRequest("own/t", table(rows, COLUMNS), "demo")
    cells = network_sizes(request)
    assert set(cells) == {("a", "size"), ("wrong", "size")}
    cell = cells["a", "size"]
    assert cell.mean * 1e6 == pytest.approx(MFNET)
    assert (cell.seeds, cell.keys, cell.reason, math.isnan(cell.sd)) == (0, (), "", True)
    assert cells["wrong", "size"].mark == "no value"
    assert "there is no model 'mfnte'; did you mean 'mfnet" in cells["wrong", "size"].reason
    cells = network_sizes(replace(request, extra=("model.num_classes=14",)))
    assert cells["a", "size"].mean * 1e6 == pytest.approx(FOURTEEN)
