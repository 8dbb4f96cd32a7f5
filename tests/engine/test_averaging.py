"""Averages of the weights: computed by hand, resumed to the same bits, and off by default."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.averaging import AveragedWeights
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import rank
from tests.checkpoints.test_torch_files import same
from tests.engine.test_trainer import SETTINGS, batches, make, make_two
from tests.processes import run_in_processes


def averaged(model: nn.Module, **changes: Any) -> AveragedWeights:
    return AveragedWeights(model, TrainerSettings(**{**SETTINGS, **changes}))


def scalar(value: float) -> nn.Linear:
    layer = nn.Linear(1, 1, bias=False)
    set_to(layer, value)
    return layer


def set_to(layer: nn.Linear, value: float) -> None:
    with torch.no_grad():
        layer.weight.fill_(value)


def test_ema_values_follow_decay_and_warm_up() -> None:
    layer = scalar(1.0)
    average = averaged(layer, averaging="ema", ema_decay=0.15)
    set_to(layer, 2.0)
    average.update(1)  # decay 1/10, because 1 / (1 + 9) < 0.15
    assert average.weights()["weight"].item() == pytest.approx(0.1 * 1.0 + 0.9 * 2.0)
    set_to(layer, 4.0)
    average.update(2)  # decay 0.15, because 2 / (2 + 9) > 0.15
    assert average.weights()["weight"].item() == pytest.approx(0.15 * 1.9 + 0.85 * 4.0)
    assert layer.weight.item() == 4.0, "the network keeps its own weights"


def test_last_values_are_the_mean_of_the_last_share_of_steps() -> None:
    layer = scalar(1.0)
    average = averaged(layer, averaging="last", averaged_share=0.5, max_steps=6)
    expected = {3: 30.0, 4: 40.0, 5: (40 + 50) / 2, 6: (40 + 50 + 60) / 3}
    for step in range(1, 7):
        set_to(layer, 10.0 * step)
        average.update(step)
        if step in expected:
            assert average.weights()["weight"].item() == pytest.approx(expected[step])
        assert (average.unaveraged() is None) == (step < 4)


def test_none_evaluates_the_weights_of_the_network_itself() -> None:
    layer = scalar(1.0)
    average = averaged(layer)
    average.update(1)
    set_to(layer, 5.0)
    average.update(2)
    assert average.weights()["weight"].data_ptr() == layer.weight.data_ptr()
    assert average.unaveraged() is None


def test_buffers_statistics_are_averaged_and_counters_are_the_last() -> None:
    norm = nn.BatchNorm1d(1, momentum=0.5)  # mean 0, variance 1, no batch yet
    average = averaged(norm, averaging="ema", ema_decay=0.0)
    mean = averaged(norm, averaging="last", averaged_share=1.0, max_steps=2)
    norm(torch.tensor([[1.0], [3.0]]))  # running mean 0.5 * 2 = 1, variance 0.5 + 0.5 * 2 = 1.5
    average.update(1)
    mean.update(1)
    norm(torch.tensor([[4.0], [6.0]]))  # 0.5 + 0.5 * 5 = 3, 0.75 + 0.5 * 2 = 1.75
    average.update(2)
    mean.update(2)
    assert average.weights()["running_mean"].item() == pytest.approx(3.0)
    assert mean.weights()["running_mean"].item() == pytest.approx((1 + 3) / 2)
    assert mean.weights()["running_var"].item() == pytest.approx((1.5 + 1.75) / 2)
    assert mean.weights()["num_batches_tracked"].item() == 2


def test_in_network_puts_the_own_weights_back_bit_for_bit() -> None:
    layer = scalar(1.0)
    average = averaged(layer, averaging="ema", ema_decay=0.5)
    set_to(layer, 0.1)
    average.update(1)
    own = layer.weight.detach().clone()
    with suppress(KeyError), average.in_network():
        inside = layer.weight.item()
        raise KeyError
    assert inside == pytest.approx(0.1 * 1.0 + 0.9 * 0.1)
    assert torch.equal(layer.weight, own)


def test_in_network_shared_weights_are_put_back() -> None:
    first, second = nn.Linear(1, 1, bias=False), nn.Linear(1, 1, bias=False)
    second.weight = first.weight
    set_to(first, 1.0)
    tied = nn.Sequential(first, second)
    average = averaged(tied, averaging="ema", ema_decay=0.5)
    set_to(first, 2.0)
    average.update(1)
    with average.in_network():
        assert second.weight.item() == pytest.approx(1.9)
    assert first.weight.item() == 2.0


@pytest.mark.parametrize("averaging", ["ema", "last"])
def test_resume_with_averaging_equals_straight_through(tmp_path: Path, averaging: str) -> None:
    changes = {"averaging": averaging, "ema_decay": 0.6, "averaged_share": 0.5}
    straight, _ = make(tmp_path / "a", **changes)
    straight.fit(batches(0), State(seed=7))

    first, _ = make(tmp_path / "b", **changes)

    def five() -> Any:
        source = batches(0)
        for _ in range(5):
            yield next(source)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.fit(five(), State(seed=7))
    second, _ = make(tmp_path / "b", **changes)
    state = State(seed=7)
    assert second.resume(state)
    assert state.step == 4
    second.fit(batches(4), state)

    for name in ("last.pt", "best.pt"):
        one, other = (load_checkpoint(tmp_path / each / name) for each in "ab")
        one.pop("state", None), other.pop("state", None)
        assert same(one, other), name


def test_checkpoints_hold_the_averaged_weights_and_those_to_resume_from(tmp_path: Path) -> None:
    trainer, log = make(tmp_path / "ema", averaging="ema", ema_decay=0.6)
    plain, plain_log = make(tmp_path / "plain")
    seen: list[Tensor] = []

    def validate(step: int) -> float:
        seen.append(next(iter(trainer.model.parameters())).detach().clone())
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
    assert torch.equal(next(iter(trainer.model.parameters())), own["model"]["0.weight"])


def test_discriminator_is_not_averaged(tmp_path: Path) -> None:
    checkpoints = []
    for name, averaging in (("a", "ema"), ("b", "none")):
        make_two(tmp_path / name, averaging=averaging).fit(batches(0), State(seed=7))
        checkpoints.append(load_checkpoint(tmp_path / name / "last.pt"))
    assert same(checkpoints[0]["others"], checkpoints[1]["others"])
    assert not same(checkpoints[0]["model"], checkpoints[1]["model"])


@pytest.mark.parametrize(("wrote", "resumes"), [("none", "ema"), ("ema", "none")])
def test_checkpoint_of_another_averaging_is_refused(
    tmp_path: Path, wrote: str, resumes: str
) -> None:
    trainer, _ = make(tmp_path, averaging=wrote)
    trainer.fit(batches(0), State(seed=7))
    other, _ = make(tmp_path, averaging=resumes)
    with pytest.raises(InputError, match=f"averaged weights, but trainer.averaging is {resumes}"):
        other.resume(State(seed=7))


def _shared_statistics() -> tuple[float, float, float]:
    norm = nn.BatchNorm1d(1, momentum=1.0)
    average = averaged(norm, averaging="ema", ema_decay=0.0)
    own = 10.0 * (rank() + 1)
    norm(torch.tensor([[own], [own]]))
    average.update(1)
    before = average.weights()["running_mean"].item()
    average.share_buffers()
    return before, average.weights()["running_mean"].item(), norm.running_mean.item()


def test_share_buffers_gives_all_processes_those_of_process_0() -> None:
    found = run_in_processes(_shared_statistics, 2)
    assert found == [(10.0, 10.0, 10.0), (20.0, 10.0, 20.0)]
