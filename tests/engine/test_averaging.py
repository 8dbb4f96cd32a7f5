"""Averages of the weights: computed by hand, resumed to the same bits, and off by default."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.averaging import AveragedNetwork
from rgbt.engine.checkpoint import EvaluatedWeights, State, load_checkpoint
from rgbt.engine.settings import TrainerSettings
from tests.checkpoints.test_torch_files import same
from tests.engine.test_trainer import SETTINGS, batches, make, make_two, stopping_after


def averaged(model: nn.Module, **changes: Any) -> EvaluatedWeights:
    return EvaluatedWeights(model, TrainerSettings(**{**SETTINGS, **changes}))


def values_after(weights: list[float], **changes: Any) -> list[float]:
    """A weight is 1, then one of these after each step: what is evaluated after each."""
    layer = nn.Linear(1, 1, bias=False)
    nn.init.constant_(layer.weight, 1.0)
    average, found = averaged(layer, **changes), []
    for step, weight in enumerate(weights, 1):
        nn.init.constant_(layer.weight, weight)
        average.update(step)
        found.append(average.state()["model"]["weight"].item())
        assert layer.weight.item() == weight, "the network keeps its own weights"
        assert ("unaveraged" in average.state()) == (average.network is not layer)
    return found


def test_ema_values_follow_decay_and_warm_up() -> None:
    """Decay 1/10 first, because 1 / (1 + 9) < 0.15; then 0.15, because 2 / (2 + 9) > 0.15."""
    found = values_after([2.0, 4.0], averaging="ema", ema_decay=0.15)
    assert found == pytest.approx([0.1 * 1 + 0.9 * 2, 0.15 * 1.9 + 0.85 * 4])


def test_last_values_average_the_last_share_of_steps() -> None:
    weights = [10.0, 20.0, 30.0, 40.0, 50.0, 60.0]
    found = values_after(weights, averaging="last", averaged_share=0.5, max_steps=6)
    assert found == pytest.approx([10, 20, 30, 40, (40 + 50) / 2, (40 + 50 + 60) / 3])
    assert values_after(weights) == weights


def test_statistics_are_averaged_and_counters_are_the_last() -> None:
    norm = nn.BatchNorm1d(1, momentum=0.5)  # mean 0, variance 1, no batch yet
    mean = averaged(norm, averaging="last", averaged_share=1.0, max_steps=2)
    copied = AveragedNetwork(norm, buffers=False)
    norm(torch.tensor([[1.0], [3.0]]))  # running mean 0.5 * 2 = 1, variance 0.5 + 0.5 * 2 = 1.5
    mean.update(1)
    norm(torch.tensor([[4.0], [6.0]]))  # 0.5 + 0.5 * 5 = 3, 0.75 + 0.5 * 2 = 1.75
    mean.update(2)
    copied.update(norm, 0.5)
    found = mean.state()["model"]
    assert found["running_mean"].item() == pytest.approx((1 + 3) / 2)
    assert found["running_var"].item() == pytest.approx((1.5 + 1.75) / 2)
    assert found["num_batches_tracked"].item() == 2
    assert copied.module.running_mean.item() == pytest.approx(3.0)


@pytest.mark.parametrize("averaging", ["ema", "last"])
def test_resume_with_averaging_equals_straight_through(tmp_path: Path, averaging: str) -> None:
    changes = {"averaging": averaging, "ema_decay": 0.6, "averaged_share": 0.5}
    make(tmp_path / "a", **changes)[0].fit(batches(0), State(seed=7))
    with pytest.raises(KeyboardInterrupt):
        make(tmp_path / "b", **changes)[0].fit(stopping_after(5), State(seed=7))
    second, state = make(tmp_path / "b", **changes)[0], State(seed=7)
    assert second.resume(state)
    second.fit(batches(state.step), state)
    for name in ("last.pt", "best.pt"):
        ends = [load_checkpoint(tmp_path / run / name) for run in "ab"]
        assert same(*ends), name


def test_checkpoints_hold_what_was_evaluated_and_what_resumes(tmp_path: Path) -> None:
    """Training does not read the average; a discriminator has none."""
    trainer = make_two(tmp_path / "ema", averaging="ema", ema_decay=0.6)
    plain = make_two(tmp_path / "plain")
    seen: list[Tensor] = []

    def evaluate(step: int, network: nn.Module) -> float:
        seen.append(next(network.parameters()).clone())
        return float(step)

    trainer.hooks.evaluate = evaluate
    losses = []
    for run in (trainer, plain):
        run.fit(batches(0), State(seed=7))
        losses.append([values["loss"] for _, values in run.log])
    assert losses[0] == losses[1]
    last, best = (load_checkpoint(tmp_path / "ema" / name) for name in ("last.pt", "best.pt"))
    own = load_checkpoint(tmp_path / "plain/last.pt")
    assert same(last["unaveraged"], own["model"])
    assert same(last["others"], own["others"])
    assert same(last["model"], best["model"])
    assert torch.equal(last["model"]["0.weight"], seen[-1]), "what was evaluated is saved"
    assert not torch.equal(last["model"]["0.weight"], own["model"]["0.weight"])
