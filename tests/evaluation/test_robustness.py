"""Robustness of a network: which evaluations, which are made again, the table."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from rgbt.evaluation.request import EvaluationRequest, choose_corruption
from rgbt.evaluation.robustness import Condition, Measured, conditions, measure, robustness_grid
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Regions
from rgbt.requirements import Record
from tests.corruptions.recorded import Recorded

EVALUATE = "rgbt.evaluation.robustness.evaluate"


class Network(nn.Module):
    record = Record(views=("rgbt", "rgb", "thermal"))

    def __init__(self) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.arange(4.0))


def spec_of(**transform: Any) -> Any:
    return SimpleNamespace(transform=SimpleNamespace(plain={"_target_": "x", **transform}))


def opened(**changes: Any) -> Any:
    """The part of a session that is used here."""
    session = {
        "model": Network(),
        "dataset": Recorded(),
        "regions": Regions(partition="ring", regions=1, aspect="image", absent="released"),
        "spec": spec_of(test_short_edge=120),
        "trainer": SimpleNamespace(precision="32-true"),
        "domains": SimpleNamespace(source=SimpleNamespace(view=None)),
    }
    return SimpleNamespace(**session | changes)


class Evaluator:
    """Stands for `evaluate` of segmentation; the accuracy follows from the severity."""

    def __init__(self, stop_at: int = 99) -> None:
        self.calls: list[tuple[float, str | None]] = []
        self.stop_at = stop_at

    def __call__(self, session: Any, model: Any, request: EvaluationRequest) -> Any:
        if len(self.calls) == self.stop_at:
            raise KeyboardInterrupt
        severity = request.corruption.severity if request.corruption else 0.0
        self.calls.append((severity, request.view))
        right = 100 - int(severity)
        counts = Counts(
            counts=np.array([[[[right, 100 - right], [0, 100]]]] * 2),
            names=("1D", "2N"),
            night=(False, True),
            classes=("road", "car"),
            partition="ring1",
            dataset="fingerprint",
            split=request.split,
        )
        return SimpleNamespace(counts=counts)


@pytest.fixture
def evaluator(monkeypatch: pytest.MonkeyPatch) -> Evaluator:
    made = Evaluator()
    monkeypatch.setattr(EVALUATE, made)
    return made


def noise(**changes: Any) -> list[Any]:
    words = [f"corruption.{key}={value}" for key, value in changes.items()]
    return [choose_corruption("noise", ["corruption.severities=[10,50]", *words])]


def test_conditions_are_clean_branches_and_severities() -> None:
    session = opened()
    found = conditions(session, [*noise(), choose_corruption("removed:rgb")])[2:]
    assert [(each.file_stem, each.row, each.severity, each.view) for each in found] == [
        ("features-rgb", "features-rgb", 1.0, "rgb"),
        ("noise-10", "noise", 10.0, "rgbt"),
        ("noise-50", "noise", 50.0, "rgbt"),
        ("rgb_removed-1", "rgb_removed", 1.0, "rgbt"),
    ]
    # Changed settings are a row of their own.
    changed = conditions(session, [choose_corruption("occluded", ["corruption.block=16"])])
    assert {each.row for each in changed[3:]} == {"occluded_block-16"}


def test_measure_writes_counts_and_their_identity(evaluator: Evaluator, tmp_path: Path) -> None:
    measured = measure(opened(), "test", noise(), tmp_path / "out")
    assert evaluator.calls == [
        *((0.0, "rgbt"), (0.0, "thermal"), (0.0, "rgb")),
        *((10.0, "rgbt"), (50.0, "rgbt")),
    ]
    # Of 100 pixels of road 50 are seen as car: IoU 50 / 100 and 100 / 150.
    assert measured[-1][1]["mIoU"] == pytest.approx((50 / 100 + 100 / 150) / 2)
    assert measured[0][1]["mIoU"] == 1
    made = json.loads((tmp_path / "out" / "noise-50.json").read_text())
    assert made["format"] == "rgbt robustness 1"
    assert (made["row"], made["severity"], made["view"]) == ("noise", 50.0, "rgbt")
    assert (made["dataset"], made["split"]) == ("fingerprint", "test")
    assert made["corruption"]["settings"] == {"image": "both"}
    saved = Counts.load(tmp_path / "out" / "noise-50.npz")
    assert saved.counts[0, 0, 0].tolist() == [50, 50]
    again = measure(opened(), "test", noise(), tmp_path / "out")
    assert len(evaluator.calls) == 5, "nothing is made again"
    assert [each[1] for each in again] == [each[1] for each in measured]


class OtherFiles(Recorded):
    def fingerprint(self) -> str:
        return "other"


def other_weights() -> Network:
    trained = Network()
    trained.weight.data[3] += 1e-6
    return trained


@pytest.mark.parametrize(
    "changes",
    [
        {"dataset": OtherFiles()},
        {"model": other_weights()},
        {"trainer": SimpleNamespace(precision="bf16-mixed")},
        {"spec": spec_of(test_short_edge=60)},
    ],
    ids=["files", "weights", "precision", "transform"],
)
def test_measure_repeats_after_other_settings(
    evaluator: Evaluator, tmp_path: Path, changes: dict[str, Any]
) -> None:
    measure(opened(), "test", noise(), tmp_path)
    measure(opened(**changes), "test", noise(), tmp_path)
    assert len(evaluator.calls) == 10


def test_measure_repeats_damaged_files(evaluator: Evaluator, tmp_path: Path) -> None:
    measure(opened(), "test", noise(), tmp_path)
    measure(opened(), "test", noise(seed=1), tmp_path)
    assert evaluator.calls[5:] == [(10.0, "rgbt"), (50.0, "rgbt")]
    assert (tmp_path / "noise-10_seed-1.npz").exists()
    (tmp_path / "noise-10.npz").write_bytes(b"half")
    (tmp_path / "noise-50.json").write_text("{")
    measure(opened(), "test", noise(), tmp_path)
    assert len(evaluator.calls) == 9
    # Under the same name, but of a file that says otherwise since.
    (own,) = noise()
    of_rgb = choose_corruption("noise:rgb", ["corruption.severities=[10,50]"]).corruption
    measure(opened(), "test", [replace(own, corruption=of_rgb)], tmp_path)
    assert len(evaluator.calls) == 11


def test_measure_stopped_resumes_and_leaves_no_wrong_identity(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    stopped, later = Evaluator(stop_at=3), Evaluator()
    monkeypatch.setattr(EVALUATE, stopped)
    with pytest.raises(KeyboardInterrupt):
        measure(opened(), "test", noise(), tmp_path)
    monkeypatch.setattr(EVALUATE, later)
    measure(opened(), "test", noise(), tmp_path)
    assert later.calls == [(10.0, "rgbt"), (50.0, "rgbt")]

    def killed(path: Path, content: object) -> None:
        raise KeyboardInterrupt

    # Killed between the two files: the identity of counts is removed before they change.
    monkeypatch.setattr("rgbt.evaluation.robustness.write_json", killed)
    with pytest.raises(KeyboardInterrupt):
        measure(opened(model=other_weights()), "test", [], tmp_path)
    assert not (tmp_path / "clean.json").exists()


def measured_row(row: str, unit: str, *values: tuple[float, float]) -> list[Measured]:
    return [
        (Condition(row, row, row, unit, severity, "rgbt"), {"mIoU": value})
        for severity, value in values
    ]


def test_robustness_grid_of_two_rows() -> None:
    measured = [*measured_row("clean", "", (0, 0.5)), *measured_row("removed", "", (1, 0.2))]
    measured += measured_row("noise", "levels", (8, 0.4), (16, 0.3))
    grid = robustness_grid(measured, "of x")
    assert grid.header == ("", "severities", "level 0", "level 1", "level 2")
    assert grid.rows == (
        ("removed", "", "50.00", "20.00", ""),
        ("noise", "8, 16 levels", "50.00", "40.00", "30.00"),
    )
    assert robustness_grid(measured[:1], "of x").rows == (("clean", "", "50.00"),)
