"""Training, resume and evaluation on the device, as a user starts them."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from rgbt.engine.trainer import Trainer
from rgbt.metrics.counts import Counts
from rgbt.runtime.signals import Stopped
from tests.benchmarks.gpu.step_equality import compare
from tests.commands import Call, losses, only_run, short, train
from tests.on_device.places import NAME, ON_DEVICE, device, exact

__all__ = ["exact"]  # a fixture

pytestmark = ON_DEVICE
ON = (f"trainer.accelerator={NAME or 'cpu'}",)
NETWORK = ("+experiment=mfnet", "masker.patch_size=null")


@pytest.mark.usefixtures("exact")
@pytest.mark.parametrize("experiment", ["crm", "spatialseg", "temporal_con", "sh_adversarial"])
def test_a_step_is_that_of_the_cpu(experiment: str) -> None:
    row = compare(experiment, device())
    assert row["loss difference"] < 1e-3
    assert row["gradient difference"] < 1e-2
    assert row["pixels differing"] < 1e-2 * row["pixels"]


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
def test_a_stopped_run_resumes_with_the_losses_of_a_straight_one(
    call: Call, data: Path, tmp_path: Path, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = (*ON, "+experiment=crm", f"trainer.precision={precision}", *short(4))
    straight, stopped = tmp_path / "straight", tmp_path / "stopped"
    code, _, err = train(call, data, straight, *words)
    assert code == 0, err
    save = Trainer._save_when_due

    def stop_at_three(trainer: Trainer, state: object) -> None:
        save(trainer, state)
        if state.step == 3:
            raise Stopped(15)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_save_when_due", stop_at_three)
        assert train(call, data, stopped, *words)[0] != 0
    code, _, err = train(call, data, stopped, *words)
    assert code == 0, err
    assert "resumes at step 2" in err
    pairs = list(zip(*(losses(only_run(each)) for each in (straight, stopped)), strict=True))
    assert len(pairs) == 4
    for one, other in pairs:
        # A GPU adds gradients in an order that changes; the steps must still be the same.
        assert math.isclose(one["loss"], other["loss"], rel_tol=0.05), pairs


def test_an_evaluation_counts_every_pixel_once(call: Call, data: Path, tmp_path: Path) -> None:
    code, _, err = train(call, data, tmp_path / "runs", *ON, *NETWORK, *short(2))
    assert code == 0, err
    counts = Counts.load(only_run(tmp_path / "runs") / "counts_test.npz")
    assert len(counts.names) == 3
    assert (counts.counts.sum((1, 2, 3)) == 48 * 64).all()
