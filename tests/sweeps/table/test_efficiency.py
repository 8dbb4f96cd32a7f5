"""Efficiency of the rows' networks, without any run."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from rgbt.checks import InputError
from sweeps.table import efficiency
from sweeps.table.cells import CellId, TableCell
from sweeps.table.check_table import check_table
from sweeps.table.efficiency import FILE, efficiency_cells, million_parameters
from sweeps.table.request import TableRequest
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import table

SIZE = Column(name="size", efficiency="parameters")
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


def parameter_cells(request: TableRequest) -> dict[CellId, TableCell]:
    """Cells of counts that need no file."""
    return efficiency_cells(request, Path("nowhere"))


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
    assert parameter_cells(wanted(Row(label="theirs", values={"size": 3.0}))) == {}
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


class FakeProfile:
    """Answers as `rgbt profile`: the second network is slower and larger."""

    def __init__(self) -> None:
        self.calls: list[tuple[Mapping[str, Any], bool]] = []

    def __call__(self, entries: Mapping[str, Any], *, measure: bool) -> dict[str, Any]:
        self.calls.append((entries, measure))
        networks = []
        for number, name in enumerate(entries, start=1):
            times = {"latency_ms": 100.0 * number, "images_per_second": 10.0 / number}
            measured = {"peak_memory": 2**20 * number, "ratio": 1 + 1.1 * (number - 1), **times}
            nothing = dict.fromkeys(measured)
            values = {"name": name, "flops": number * 10**9}
            networks.append(values | (measured if measure else nothing))
        return {"device": "a device", "threads": 2, "torch": "2", "networks": networks}


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> FakeProfile:
    profile = FakeProfile()
    monkeypatch.setattr(efficiency, "_run_profile", profile)
    return profile


def test_all_networks_are_measured_in_one_call(fake: FakeProfile, tmp_path: Path) -> None:
    cells = efficiency_cells(wanted(*ROWS, columns=ALL), tmp_path)
    ((entries, measure),) = fake.calls
    assert measure
    words = ["+experiment=crm", "scale=paper", "model=mfnet"]
    assert entries == {
        "a": {"overrides": words, "image_hw": [480, 640]},
        "b": {"overrides": words, "image_hw": [512, 640]},
    }
    b = {column.name: cells["b", column.name] for column in ALL}
    means = {name: cell.mean for name, cell in b.items() if name != "size"}
    assert means == {"flops": 2.0, "memory": 2.0, "ms": 200.0, "fps": 5.0}
    ratios = {name: cell.ratio for name, cell in b.items()}
    assert ratios == pytest.approx(
        {"size": math.nan, "flops": math.nan, "memory": 2.0, "ms": 2.1, "fps": 1 / 2.1},
        nan_ok=True,
    )
    assert cells["as a", "ms"] == cells["a", "ms"]
    assert b["fps"].device == "a device, 2 threads, torch 2"
    assert "did you mean 'mfnet" in cells["wrong", "fps"].reason
    assert not [label for label, _ in cells if label == "theirs"]


def test_measurements_are_read_again_until_a_network_changes(
    fake: FakeProfile, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    first = efficiency_cells(wanted(*ROWS, columns=ALL), tmp_path)
    again = efficiency_cells(wanted(*ROWS, columns=ALL), tmp_path)
    assert len(fake.calls) == 1
    assert again["b", "ms"] == first["b", "ms"]
    assert f"{tmp_path / FILE}; remove the file" in capsys.readouterr().err
    efficiency_cells(wanted(*ROWS[:1], columns=ALL), tmp_path)
    assert len(fake.calls) == 2
    stored = json.loads((tmp_path / FILE).read_text())
    stored["wanted"]["machine"] = ["another", "device"]
    (tmp_path / FILE).write_text(json.dumps(stored))
    efficiency_cells(wanted(*ROWS[:1], columns=ALL), tmp_path)
    (tmp_path / FILE).write_text("no JSON")
    efficiency_cells(wanted(*ROWS[:1], columns=ALL), tmp_path)
    assert len(fake.calls) == 4


def test_counted_columns_measure_nothing(fake: FakeProfile, tmp_path: Path) -> None:
    cells = efficiency_cells(wanted(*ROWS[:3], columns=ALL[:2]), tmp_path)
    assert [measure for _, measure in fake.calls] == [False]
    assert (cells["b", "flops"].mean, cells["b", "flops"].device) == (2.0, "")
    efficiency_cells(wanted(*ROWS[:3], columns=ALL[:1]), tmp_path / "other")
    assert len(fake.calls) == 1
    assert not (tmp_path / "other").exists()


def test_failed_profile_is_the_reason_of_a_cell(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise InputError("rgbt profile failed: no memory")

    monkeypatch.setattr(efficiency, "_run_profile", fail)
    cells = efficiency_cells(wanted(*ROWS[:1], columns=ALL), tmp_path)
    assert cells["a", "fps"].reason == "rgbt profile failed: no memory"
    assert cells["a", "fps"].mark == "no value"
    assert cells["a", "size"].mean * 1e6 == pytest.approx(MFNET)
    assert not (tmp_path / FILE).exists()


@pytest.mark.slow
def test_gflops_are_those_of_the_command(tmp_path: Path) -> None:
    row = Row(
        label="a",
        experiment="crm",
        overrides=("model=mfnet",),
        settings={"image_hw": [48, 64]},
    )
    cells = efficiency_cells(wanted(row, columns=ALL[:2]), tmp_path)
    # All operations of MFNet are convolutions, so they grow with the image: 16.59 at 480 x 640.
    assert cells["a", "flops"].mean == pytest.approx(0.1659, abs=1e-4)
    refused = Row(
        label="a",
        experiment="crm",
        overrides=("model=cmx_b0",),
        settings={"image_hw": [3, 3]},
    )
    cells = efficiency_cells(wanted(refused, columns=ALL[:2]), tmp_path)
    assert "these model.sr_ratios" in cells["a", "flops"].reason


def test_check_table_refuses_a_wrong_size() -> None:
    row = Row(label="a", experiment="crm", settings={"image_hw": [480]})
    with pytest.raises(InputError, match=r"row 'a', settings, image_hw: expected \[height, width"):
        check_table(table((row,), ALL), "t.yaml")
