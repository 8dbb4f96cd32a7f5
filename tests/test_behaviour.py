"""Every experiment trains as in the recording `tests/behaviour.json`."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from typing import Any

import pytest

from tests.behaviour import EXPERIMENTS, RECORDED, compare, differences, machine, training

RECORDING: dict[str, Any] = json.loads(RECORDED.read_text())


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_ten_steps_are_the_recorded_ones(
    experiment: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    is_exact = machine() == RECORDING["machine"]
    found = training(experiment, tmp_path_factory.getbasetemp() / "recorded")
    assert not list(differences(RECORDING["experiments"][experiment], found, is_exact))


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
