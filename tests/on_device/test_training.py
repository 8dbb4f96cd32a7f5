"""Training, resume and evaluation on the device, as a user starts them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from rgbt.config.compose import available
from rgbt.engine.trainer import Trainer
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import read_provenance
from rgbt.runtime.signals import Stopped
from tests.commands import Call, losses, only_run, short, train
from tests.on_device.places import NAME, ON_DEVICE, device
from tests.on_device.steps import compare

pytestmark = ON_DEVICE
ON = (f"trainer.accelerator={NAME or 'cpu'}",)
SOME = ("crm", "spatialseg", "temporal_con", "sh_adversarial")


@pytest.mark.parametrize(
    "experiment",
    [
        pytest.param(each, marks=() if each in SOME else pytest.mark.slow)
        for each in available("experiment")
    ],
)
def test_step_is_that_of_the_cpu(experiment: str) -> None:
    """Also, no operation meets tensors of both devices."""
    row = compare(experiment, device())
    assert row["loss difference"] < 1e-3
    assert row["gradient difference"] < 1e-2
    assert row["pixels differing"] < 1e-2 * row["pixels"]


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_stopped_run_resumes_with_losses_of_straight_run(
    call: Call, data: Path, tmp_path: Path, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*ON, "+experiment=crm", f"trainer.precision={precision}", *short(4))
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    code, _, err = train(call, data, straight, *words)
    assert code == 0, err
    save = Trainer._evaluate_and_save

    def stop_at_three(trainer: Trainer, state: object) -> None:
        save(trainer, state)
        if state.step == 3:
            raise Stopped(15)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_evaluate_and_save", stop_at_three)
        assert train(call, data, stopped, *words)[0] != 0
    code, _, err = train(call, data, stopped, *words)
    assert (code, "resumes at step 2" in err) == (0, True), err
    processes = read_provenance(only_run(stopped) / "provenance.json")
    tf32 = {"cuda": "high"}.get(device().type, "highest")
    assert [process["matmul_precision"] for process in processes] == [tf32, tf32]
    pairs = list(zip(*(losses(only_run(each)) for each in (straight, stopped)), strict=True))
    assert len(pairs) == 4
    for one, other in pairs:
        # A GPU adds gradients in an order that changes; the steps must still be the same.
        assert math.isclose(one["loss"], other["loss"], rel_tol=0.05), pairs
    counts = Counts.load(only_run(stopped) / "counts_test.npz")
    assert (counts.counts.sum((1, 2, 3)) == 48 * 64).all(), "every pixel is counted once"
