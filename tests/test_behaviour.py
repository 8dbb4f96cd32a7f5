"""Every experiment trains as in the recording `tests/behaviour.json`."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.behaviour import (
    EXPERIMENTS,
    FIRST,
    RECORDED,
    UPSTREAM,
    compare,
    differences,
    machine,
    tolerance,
    training,
)

RECORDING: dict[str, Any] = json.loads(RECORDED.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_ten_steps_are_the_recorded_ones(
    experiment: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    found = training(experiment, tmp_path_factory.getbasetemp() / "recorded")
    recorded = RECORDING["experiments"][experiment]
    is_exact = machine() == recorded.get("machine", RECORDING["machine"])
    assert not list(differences(recorded, found, is_exact, tolerance(experiment)))


def scaled(factor: float, step: int) -> Callable[[dict[str, Any]], None]:
    def scale(grbm: dict[str, Any]) -> None:
        losses = grbm["steps"]["loss"]
        losses[step - 1] = (float.fromhex(losses[step - 1]) * factor).hex()

    return scale


@pytest.mark.parametrize(
    ("change", "here", "elsewhere"),
    [
        (scaled(1, 1), 0, 0),
        (scaled(1 + 2**-50, 5), 1, 0),
        (scaled(1 + 1e-3, 1), 1, 1),
        (scaled(1 + 1e-5, 1), 1, 0),
        (lambda grbm: grbm["steps"]["loss"].pop(), 1, 1),
        (lambda grbm: grbm["counts"].update({"counts_test.npz": "0"}), 1, 0),
        (lambda grbm: grbm["counts"].pop("counts_test.npz"), 1, 1),
    ],
)
def test_compare_counts_what_differs(
    change: Callable[[dict[str, Any]], object], here: int, elsewhere: int
) -> None:
    other = copy.deepcopy(RECORDING)
    change(other["experiments"]["grbm"])
    assert compare(RECORDING, other) == here
    other["machine"]["cpu"] = "another"
    assert compare(RECORDING, other) == elsewhere


def test_a_start_from_an_upstream_run_differs_more_on_another_machine() -> None:
    assert tolerance("grbm") == FIRST
    assert tolerance("heatnet_rgb_only") == tolerance("multi_head_night") == UPSTREAM
