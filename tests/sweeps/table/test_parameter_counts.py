"""Parameters of the rows' networks, counted from their configuration only."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch

from rgbt.checks import InputError
from sweeps.table.request import TableRequest, million_parameters, parameter_cells
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import table

SIZE = Column(name="size", parameters=True)
MFNET = 736_275
"""As its authors count it, at nine classes."""


def unit(channels_in: int, channels_out: int) -> int:
    """A 3 x 3 convolution with bias and the batch normalisation behind it."""
    return 9 * channels_in * channels_out + channels_out + 2 * channels_out


def inception(channels_in: int, channels_out: int) -> int:
    """Three levels of two units, each with half of the channels."""
    half = channels_out // 2
    return 2 * (unit(channels_in, half) + unit(channels_out, half) + unit(channels_out, half))


def encoder(channels: int, full: int, half: int, quarter: int, eighth: int) -> int:
    plain = unit(channels, full) + unit(full, half) + unit(half, half)
    plain += unit(half, quarter) + unit(quarter, quarter)
    return plain + inception(quarter, eighth) + inception(eighth, eighth)


def decoder(classes: int) -> int:
    """From the channels of both encoders added: 132, 64, 64, then 32, then the classes."""
    return unit(132, 64) + unit(64, 64) + unit(64, 32) + unit(32, classes)


def wanted(*rows: Row, columns: tuple[Column, ...] = (SIZE,), **others: Any) -> TableRequest:
    return TableRequest("own/t", table(rows, columns, **others), "demo", (0, 1))


def test_parameters_by_hand() -> None:
    encoders = encoder(3, 16, 48, 48, 96) + encoder(1, 16, 16, 16, 36)
    assert encoders + decoder(9) == MFNET
    nine = million_parameters(["scale=paper", "model=mfnet"])
    assert nine * 1e6 == pytest.approx(MFNET)
    fourteen = million_parameters(["scale=paper", "model=mfnet", "dataset.num_classes=14"])
    assert fourteen * 1e6 == pytest.approx(encoders + decoder(14))


def test_parameter_cells_use_paper_scale() -> None:
    row = Row(label="a", experiment="crm", at={"paper": ("model=mfnet",)})
    cells = parameter_cells(wanted(row))
    cell = cells["a", "size"]
    assert cell.mean * 1e6 == pytest.approx(MFNET)
    assert (cell.seeds, cell.keys, cell.reason, math.isnan(cell.sd)) == (0, (), "", True)


def test_network_is_counted_once_without_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    built: list[str] = []
    allocate = torch.nn.Parameter.__new__

    def watched(cls: Any, data: torch.Tensor, *rest: Any, **named: Any) -> Any:
        built.append(data.device.type)
        return allocate(cls, data, *rest, **named)

    monkeypatch.setattr(torch.nn.Parameter, "__new__", watched)
    rows = [Row(label=label, experiment="crm", overrides=("model=mfnet",)) for label in "abc"]
    cells = parameter_cells(wanted(*rows))
    once = len(built)
    parameter_cells(wanted(rows[0]))
    assert [cell.mean for cell in cells.values()] == [pytest.approx(MFNET / 1e6)] * 3
    assert (len(built), set(built)) == (2 * once, {"meta"})


def test_parameter_cells_skip_unrunnable_rows() -> None:
    row = Row(label="a", experiment="crm")
    later = Row(label="later", experiment="crm", needs="a part")
    assert parameter_cells(wanted(later, Row(label="theirs", values={"size": 3.0}))) == {}
    assert parameter_cells(wanted(row, needs="a part")) == {}
    assert parameter_cells(wanted(row, columns=(Column(name="acc", metric="mIoU"),))) == {}


def test_parameter_cells_follow_overrides_and_report_errors() -> None:
    rows = (
        Row(label="a", experiment="crm", overrides=("model=mfnet",)),
        Row(label="b", experiment="crm", overrides=("model=mfnte",)),
    )
    asked = TableRequest("own/t", table(rows, (SIZE,)), "demo", (0,), ("model.num_classes=14",))
    cells = parameter_cells(asked)
    assert cells["a", "size"].mean * 1e6 == pytest.approx(MFNET - decoder(9) + decoder(14))
    assert cells["b", "size"].mark == "no value"
    assert "there is no model 'mfnte'; did you mean 'mfnet" in cells["b", "size"].reason
    with pytest.raises(InputError, match=r"model\.width"):
        million_parameters(["model=mfnet", "+model.width=3"])
