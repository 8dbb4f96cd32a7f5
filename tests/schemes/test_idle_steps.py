"""HeatNet's one RMSprop for two networks: what the idle network's optimizer does, written out."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from rgbt.engine.checkpoint import State
from rgbt.engine.optimizers import RMSprop, step_without_gradient
from rgbt.types import Phase
from tests.composed import specified
from tests.schemes.linear import Values, assert_same, network, pairs, trainer, values_of
from tests.schemes.test_adversarial import HEATNET, ONLY, SHARED, ByHand, critic, scheme_of

RATE, ALPHA, EPS = 0.01, 0.9, 1e-8


@dataclass
class MeanSquares:
    """RMSprop without momentum, as its formula: v = a v + (1 - a) g^2; p -= r g / (sqrt(v) + e)."""

    names: tuple[str, ...]
    squares: Values = field(default_factory=dict)

    def step(self, values: Values, gradient: Values) -> None:
        for name in self.names:
            before = self.squares.get(name, torch.zeros_like(values[name]))
            self.squares[name] = ALPHA * before + (1 - ALPHA) * gradient[name] ** 2
            values[name] = values[name] - RATE * gradient[name] / (self.squares[name].sqrt() + EPS)

    def decay(self) -> None:
        """A step with a gradient of 0: the mean decays, the value stays."""
        self.squares = {name: ALPHA * each for name, each in self.squares.items()}


def by_hand(model: nn.Module, judge: nn.Module, steps: int, *, released: bool) -> ByHand:
    """Alternating steps, the discriminator's first; the released optimizer also decays the idle."""
    made = ByHand(HEATNET, False, values_of(model), values_of(judge))
    of_network, of_critic = MeanSquares((SHARED, ONLY)), MeanSquares(("weight", "bias"))
    made.day, made.of_critic = of_network, of_critic  # type: ignore[assignment]
    for pair in islice(pairs(confidence=True), steps):
        made.step(pair)
        if released:
            (of_network if pair.step % 2 == 0 else of_critic).decay()
    return made


def after(folder: Path, steps: int, idle_steps: str, stop: int = 0) -> tuple[nn.Module, nn.Module]:
    """Network and discriminator after alternating steps; optionally resumed after `stop` steps."""
    model = network(False)
    builder = RMSprop(lr=RATE, alpha=ALPHA, eps=EPS)
    settings: dict[str, Any] = {**HEATNET, "idle_steps": idle_steps}
    scheme = scheme_of(model, critic_optimizer=builder, **settings)
    for first, last in ((0, stop), (stop, steps)) if stop else ((0, steps),):
        made = trainer(scheme, model, folder, last, checkpoint_every=1)
        made.optimizers = {"main": builder(model), "critic": builder(scheme.others["critic"])}
        state = State(seed=0)
        assert made.resume(state) == bool(first)
        made.fit(pairs(first, confidence=True), state)
    return model, scheme.others["critic"]


@pytest.mark.parametrize("idle_steps", ["none", "released"])
@pytest.mark.parametrize("stop", [0, 3])
def test_seven_alternating_steps_are_those_written_out(
    tmp_path: Path, idle_steps: str, stop: int
) -> None:
    expected = by_hand(network(False), critic(), 7, released=idle_steps == "released")
    model, judge = after(tmp_path, 7, idle_steps, stop)
    assert_same(model, expected.values)
    assert_same(judge, expected.judge)


def test_step_without_gradient_acts_on_momentum_and_decay_of_stepped_parameters() -> None:
    """Momentum 0.5 and decay 0.1: d = 0.1 p, b = 0.5 b + d, p -= b. New parameters stay."""
    old, new = (nn.Parameter(torch.tensor(value)) for value in (2.0, 3.0))
    optimizer = torch.optim.SGD([old, new], lr=1.0, momentum=0.5, weight_decay=0.1)
    old.grad = torch.tensor(1.0)
    optimizer.step()  # b = 1 + 0.2, p = 2 - 1.2
    assert old.item() == pytest.approx(0.8)
    new.grad = torch.tensor(7.0)  # of another phase
    step_without_gradient(optimizer)  # b = 0.6 + 0.08, p = 0.8 - 0.68
    assert (old.item(), new.item()) == (pytest.approx(0.12), 3.0)
    assert old.grad is None
    assert new.grad is None


def test_phases_name_the_idle_optimizers_of_the_released_form() -> None:
    def idle(step: int, **changes: Any) -> list[tuple[str, ...]]:
        from dataclasses import replace

        from tests.schemes.linear import generator_of

        scheme = scheme_of(network(False), **{**HEATNET, **changes})
        pair = replace(next(pairs(confidence=True)), step=step)
        found: list[Phase] = list(scheme.phases(pair.to("cpu"), generator_of))
        return [phase.idle for phase in found]

    assert (idle(0), idle(1)) == ([()], [()])
    assert idle(0, idle_steps="released") == [("main",)]
    assert idle(1, idle_steps="released") == [("critic",)]


def test_only_the_released_form_changes_the_key() -> None:
    plain = specified(("+experiment=heatnet",))
    assert plain.scheme.values["idle_steps"] == "none"
    assert specified(("+experiment=heatnet", "scheme.idle_steps=released")).key != plain.key
    for scale in ((), ("scale=paper", "dataset.root=x")):
        for name in ("heatnet_released",):
            scheme = specified((f"+experiment={name}", *scale)).scheme
            assert scheme.values["idle_steps"] == "released"
