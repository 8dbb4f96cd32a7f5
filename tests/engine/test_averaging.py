"""Averages of the weights: computed by hand, resumed to the same bits, and off by default."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.averaging import AveragedNetwork
from rgbt.engine.checkpoint import EvaluatedWeights
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.engine.settings import TrainerSettings
from tests.checkpoints.test_torch_files import same
from tests.engine.test_trainer import SETTINGS, batches, make, make_two, stopping_after


def averaged(model: nn.Module, **changes: Any) -> EvaluatedWeights:
    return EvaluatedWeights(model, TrainerSettings(**{**SETTINGS, **changes}))


def scalar(value: float) -> nn.Linear:
    layer = nn.Linear(1, 1, bias=False)
    set_to(layer, value)
    return layer


def set_to(layer: nn.Linear, value: float) -> None:
    with torch.no_grad():
        layer.weight.fill_(value)


def value_of(average: EvaluatedWeights) -> float:
    return average.state()["model"]["weight"].item()


def test_ema_values_follow_decay_and_warm_up() -> None:
    layer = scalar(1.0)
    average = averaged(layer, averaging="ema", ema_decay=0.15)
    set_to(layer, 2.0)
    average.update(1)  # decay 1/10, because 1 / (1 + 9) < 0.15
    assert value_of(average) == pytest.approx(0.1 * 1.0 + 0.9 * 2.0)
    set_to(layer, 4.0)
    average.update(2)  # decay 0.15, because 2 / (2 + 9) > 0.15
    assert value_of(average) == pytest.approx(0.15 * 1.9 + 0.85 * 4.0)
    assert layer.weight.item() == 4.0, "the network keeps its own weights"


def test_last_values_are_the_mean_of_the_last_share_of_steps() -> None:
    layer = scalar(1.0)
    average = averaged(layer, averaging="last", averaged_share=0.5, max_steps=6)
    expected = {3: 30.0, 4: 40.0, 5: (40 + 50) / 2, 6: (40 + 50 + 60) / 3}
    for step in range(1, 7):
        set_to(layer, 10.0 * step)
        average.update(step)
        if step in expected:
            assert value_of(average) == pytest.approx(expected[step])
        assert ("unaveraged" in average.state()) == (step >= 4)


def test_none_evaluates_the_network_itself() -> None:
    layer = scalar(1.0)
    average = averaged(layer)
    average.update(1)
    assert average.network is layer
    assert list(average.state()) == ["model"]


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
    straight, _ = make(tmp_path / "a", **changes)
    straight.fit(batches(0), State(seed=7))
    first, _ = make(tmp_path / "b", **changes)
    with pytest.raises(KeyboardInterrupt):
        first.fit(stopping_after(5), State(seed=7))
    second, _ = make(tmp_path / "b", **changes)
    state = State(seed=7)
    assert second.resume(state)
    assert state.step == 4
    second.fit(batches(4), state)
    for name in ("last.pt", "best.pt"):
        one, other = (load_checkpoint(tmp_path / each / name) for each in "ab")
        assert same(one, other), name


def test_checkpoints_hold_what_was_evaluated_and_what_resumes(tmp_path: Path) -> None:
    trainer, log = make(tmp_path / "ema", averaging="ema", ema_decay=0.6)
    plain, plain_log = make(tmp_path / "plain")
    seen: list[Tensor] = []

    def validate(step: int) -> float:
        seen.append(next(trainer.weights.network.parameters()).clone())
        return float(step)

    trainer.validate = validate
    for each in (trainer, plain):
        each.fit(batches(0), State(seed=7))
    losses = [[values["loss"] for _, values in each] for each in (log, plain_log)]
    assert losses[0] == losses[1], "training does not read the average"
    last, best = (load_checkpoint(tmp_path / "ema" / name) for name in ("last.pt", "best.pt"))
    own = load_checkpoint(tmp_path / "plain/last.pt")
    assert same(last["unaveraged"], own["model"])
    assert same(last["model"], best["model"])
    assert torch.equal(last["model"]["0.weight"], seen[-1]), "what was evaluated is saved"
    assert not torch.equal(last["model"]["0.weight"], own["model"]["0.weight"])
    assert "unaveraged" not in own


def test_discriminator_is_not_averaged(tmp_path: Path) -> None:
    checkpoints = []
    for name, averaging in (("a", "ema"), ("b", "none")):
        make_two(tmp_path / name, averaging=averaging).fit(batches(0), State(seed=7))
        checkpoints.append(load_checkpoint(tmp_path / name / "last.pt"))
    assert same(checkpoints[0]["others"], checkpoints[1]["others"])
    assert not same(checkpoints[0]["model"], checkpoints[1]["model"])
