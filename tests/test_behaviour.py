"""Every experiment composes, is named and trains as in the recording `tests/behaviour.json`.

Configurations and keys are compared on every machine. Losses, gradients, learning rates and counts
of ten steps are compared bit for bit where torch, the CPU capability that it uses, the kind of
processor and the platform are those of the recording. Elsewhere the first value of every loss
agrees within a relative tolerance of 1e-4; later values, which training moves apart, and counts are
not compared.

An experiment that is added is recorded by ``python -m tests.behaviour record``; a key that changes
means that runs on users' disks are not found again.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.behaviour import (
    EXPERIMENTS,
    RECORDED,
    archive_digest,
    compare,
    composition,
    composition_differences,
    machine,
    processor,
    settings_of,
    training,
    training_differences,
    written,
)

RECORDING: dict[str, Any] = json.loads(RECORDED.read_text())
QUICK = {
    *(("grbm", "smoke"), ("grbm", "paper"), ("cmx_released", "demo"), ("rtfnet", "demo")),
    *(("temporal_con", "paper"), ("multi_head_night_stage1", "demo"), ("crm_pst900", "smoke")),
}


def test_every_experiment_is_recorded() -> None:
    assert list(RECORDING["experiments"]) == EXPERIMENTS


@pytest.mark.parametrize(
    ("experiment", "setting"),
    [
        pytest.param(name, setting, marks=() if (name, setting) in QUICK else pytest.mark.slow)
        for name in EXPERIMENTS
        for setting in settings_of(name)
    ],
)
def test_composition_is_the_recorded_one(experiment: str, setting: str) -> None:
    recorded = RECORDING["experiments"][experiment]["compositions"][setting]
    found = composition(experiment, setting)
    assert not list(composition_differences(setting, recorded, found))


@pytest.fixture(scope="module")
def runs_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("runs")


@pytest.mark.slow
@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_ten_steps_are_the_recorded_ones(experiment: str, runs_dir: Path) -> None:
    recorded = RECORDING["experiments"][experiment]["training"]
    found = training(experiment, runs_dir)
    is_exact = machine() == RECORDING["machine"]
    assert not list(training_differences(recorded, found, is_exact))


def test_compare_same_recordings_finds_nothing(capsys: pytest.CaptureFixture[str]) -> None:
    assert compare(RECORDING, json.loads(written(RECORDING))) == 0
    assert capsys.readouterr().out.count(" same\n") == len(EXPERIMENTS)


def larger(recording: dict[str, Any], factor: float, step: int) -> None:
    losses = recording["experiments"]["grbm"]["training"]["steps"]["loss"]
    losses[step - 1] = (float.fromhex(losses[step - 1]) * factor).hex()


def other_key(recording: dict[str, Any]) -> None:
    recording["experiments"]["grbm"]["compositions"]["paper"]["key"] = "0123456789ab"


def other_node(recording: dict[str, Any]) -> None:
    recording["experiments"]["grbm"]["compositions"]["demo"]["nodes"]["scheme"] = "0"


def other_counts(recording: dict[str, Any]) -> None:
    recording["experiments"]["grbm"]["training"]["counts"]["counts_test.npz"] = "0"


def no_counts(recording: dict[str, Any]) -> None:
    del recording["experiments"]["grbm"]["training"]["counts"]["counts_test.npz"]


def fewer_steps(recording: dict[str, Any]) -> None:
    recording["experiments"]["grbm"]["training"]["steps"]["loss"].pop()


def no_experiment(recording: dict[str, Any]) -> None:
    del recording["experiments"]["grbm"]


Change = Callable[[dict[str, Any]], None]
CHANGES: list[tuple[Change, str, int]] = [
    (lambda changed: larger(changed, 1 + 2**-50, step=5), "loss differs from value 5", 0),
    (lambda changed: larger(changed, 1 + 1e-3, step=1), "loss differs from value 1", 1),
    (lambda changed: larger(changed, 1 + 1e-5, step=1), "loss differs from value 1", 0),
    (other_key, "paper: key 20d6aec51527 became 0123456789ab", 1),
    (other_node, "demo: configuration of scheme differs", 1),
    (other_counts, "counts_test.npz differs", 0),
    (no_counts, "counts_test.npz differs", 1),
    (fewer_steps, "loss was logged 10 times, now 9 times", 1),
    (no_experiment, "only in one of the recordings", 1),
]
"""A change, what names it on the same machine, and whether it counts on another machine."""


@pytest.mark.parametrize(("change", "sentence", "elsewhere"), CHANGES)
def test_compare_changed_recording_names_the_change(
    change: Change, sentence: str, elsewhere: int, capsys: pytest.CaptureFixture[str]
) -> None:
    changed = copy.deepcopy(RECORDING)
    change(changed)
    assert compare(RECORDING, changed) == 1
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("grbm "))
    assert sentence in line
    changed["machine"]["cpu"] = "another"
    assert compare(RECORDING, changed) == elsewhere


PROCESSOR = """processor\t: {number}
vendor_id\t: AuthenticAMD
cpu family\t: {family}
model\t\t: 17
model name\t: AMD EPYC
stepping\t: 1
cpu MHz\t\t: {speed}
flags\t\t: {flags}

"""


def listed(family: int = 25, speed: float = 2400.0, flags: str = "avx2 avx512f") -> str:
    """What Linux lists of two processors of one kind."""
    parts = {"family": family, "flags": flags}
    return "".join(
        PROCESSOR.format(number=number, speed=speed + number, **parts) for number in (0, 1)
    )


def test_processors_with_the_same_name_differ() -> None:
    assert processor(listed()).startswith("AuthenticAMD 25 17 1 - - ")
    assert processor(listed(speed=3100.5)) == processor(listed())
    assert processor(listed(family=26)) != processor(listed())
    assert processor(listed(flags="avx2 avx512f avx512_bf16")) != processor(listed())
    arm = "processor: 0\nFeatures: asimd\nCPU implementer: 0x41\nCPU part: 0xd0c\n"
    assert processor(arm) != processor(arm.replace("0xd0c", "0xd40"))
    assert processor(arm) != processor(arm.replace("asimd", "asimd sve"))
    assert "processor" in machine()


def test_archive_digest_depends_only_on_arrays(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ("a.npz", "b.npz", "c.npz")]
    np.savez(paths[0], counts=np.arange(4), names=np.array(["x"]))
    np.savez_compressed(paths[1], names=np.array(["x"]), counts=np.arange(4))
    np.savez(paths[2], counts=np.array([0, 1, 2, 4]), names=np.array(["x"]))
    first, same, other = map(archive_digest, paths)
    assert first == same != other
