"""Adversarial steps: both phases by matrices, numbers from the papers, and who steps what."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import islice
from math import log
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import State
from rgbt.engine.optimizers import SGD
from rgbt.schemes.adversarial import Adversarial
from rgbt.types import TwoDomains
from tests.schemes.linear import (
    LR,
    MOMENTUM,
    Cost,
    K,
    Linear,
    Momentum,
    Values,
    assert_same,
    cross_entropy,
    domains,
    generator_of,
    gradient,
    nats,
    network,
    pairs,
    pixels,
    scores,
    trained,
    trainer,
    values_of,
    written_out,
)

DAY, DARK, ONLY, SHARED = "heads.day.weight", "heads.dark.weight", "only.weight", "backbone.weight"
CRITIC = ("weight", "bias")

PAPERS: dict[str, Any] = {
    "judged": "probabilities",
    "verdict_loss": "least_squares",
    "source_value": 0.0,
    "target_value": 1.0,
    "weight": 0.4,
    "both_ways": False,
    "weighed_by_confidence": False,
    "halved": False,
    "supervise_target": False,
    "alternates": False,
    "gradients": "apart",
}
HEATNET = {
    **PAPERS,
    **{"judged": "logits", "source_value": 1.0, "target_value": 0.0, "both_ways": True},
    **{"weighed_by_confidence": True, "supervise_target": True, "alternates": True},
}


def critic() -> nn.Conv2d:
    torch.manual_seed(5)
    return nn.Conv2d(K, 1, 1)


def scheme_of(model: nn.Module, heads: bool = False, **changes: Any) -> Adversarial:
    settings = {**PAPERS, **changes}
    labels = "/pseudo" if settings["supervise_target"] else "none"
    confidence = settings["weighed_by_confidence"]
    given: dict[str, Any] = {
        "loss": cross_entropy,
        "domains": domains(heads, labels=labels, confidence=confidence),
        "critic": critic(),
        "critic_optimizer": SGD(
            lr=LR, backbone_multiplier=1.0, momentum=MOMENTUM, weight_decay=0.0
        ),
    }
    return Adversarial(model=model, **{**given, **settings})


# ---- the same by matrices -------------------------------------------------------------------


def shown(z: Tensor, how: str) -> Tensor:
    p = z.exp() / z.exp().sum(1, keepdim=True)
    return {"probabilities": p, "logits": z, "self_information": -p * p.log() / log(K)}[how]


def distance(verdicts: Tensor, value: float, how: str) -> Tensor:
    if how == "least_squares":
        return ((value - verdicts) ** 2).mean()
    s = 1 / (1 + (-verdicts).exp())
    return -(value * s.log() + (1 - value) * (1 - s).log()).mean()


@dataclass
class ByHand:
    """A network and a discriminator as matrices, stepped as the documentation says."""

    settings: dict[str, Any]
    heads: bool
    values: Values
    judge: Values

    def __post_init__(self) -> None:
        self.names = {"source": DAY, "target": DARK} if self.heads else dict.fromkeys(
            ("source", "target"), ONLY
        )  # fmt: skip
        self.day = Momentum((SHARED, self.names["source"]))
        self.dark = Momentum((SHARED, DARK)) if self.heads else None
        self.of_critic = Momentum(CRITIC)

    def verdicts(self, seen: Tensor, judge: Values) -> Tensor:
        return seen @ judge["weight"].T + judge["bias"]

    def cost_of(self, pair: TwoDomains, name: str) -> Cost:
        """Segmentation and adversarial cost of a domain."""
        given, judge = self.settings, dict(self.judge)
        batch, view = (pair.source, "rgb") if name == "source" else (pair.target, "thermal")
        x, y = pixels(batch, view)
        wrong = given["target_value" if name == "source" else "source_value"]
        weight = given["weight"]
        if given["weighed_by_confidence"]:
            weight = weight * (1 - pair.target.confidence.double()).mean()

        def cost(values: Values) -> Tensor:
            z = scores(values, x, self.names[name])
            found = torch.zeros((), dtype=torch.float64)
            if name == "source" or given["supervise_target"]:
                found = found + nats(z, y)
            if name == "target" or given["both_ways"]:
                found = found + weight * distance(
                    self.verdicts(shown(z, given["judged"]), judge), wrong, given["verdict_loss"]
                )
            return found

        return cost

    def critic_step(self, pair: TwoDomains, at: tuple[Values, Values]) -> None:
        given = self.settings
        maps = [
            shown(scores(values, pixels(batch, view)[0], self.names[name]), given["judged"])
            for values, batch, view, name in (
                (at[0], pair.source, "rgb", "source"),
                (at[1], pair.target, "thermal", "target"),
            )
        ]
        share = 0.5 if given["halved"] else 1.0
        wanted = (given["source_value"], given["target_value"])

        def cost(judge: Values) -> Tensor:
            costs = [
                distance(self.verdicts(seen, judge), value, given["verdict_loss"])
                for seen, value in zip(maps, wanted, strict=True)
            ]
            return share * (costs[0] + costs[1])

        self.of_critic.step(self.judge, gradient(cost, self.judge))

    def step(self, pair: TwoDomains) -> None:
        if self.settings["alternates"] and pair.step % 2 == 0:
            self.critic_step(pair, (self.values, self.values))
            return
        source, target = self.cost_of(pair, "source"), self.cost_of(pair, "target")
        mode = self.settings["gradients"]
        at = written_out(self.values, mode, self.day, self.dark, source, target)
        if not self.settings["alternates"]:
            self.critic_step(pair, at)


CASES: dict[str, tuple[bool, dict[str, Any]]] = {
    "thesis, Eqs. 4 to 6, one head": (False, {}),
    "thesis, two heads": (True, {}),
    "thesis' code, second stage": (True, {"gradients": "together"}),
    "thesis' code, basic": (True, {"gradients": "kept", "supervise_target": True}),
    "thesis' code, one head": (False, {"supervise_target": True}),
    "AdaptSegNet": (False, {"verdict_loss": "cross_entropy", "halved": True}),
    "ADVENT": (
        False,
        {"judged": "self_information", "verdict_loss": "cross_entropy", "halved": True},
    ),
    "HeatNet": (False, HEATNET),
    "HeatNet without teacher": (
        False,
        {**HEATNET, "weighed_by_confidence": False, "supervise_target": False},
    ),
    "HeatNet, both phases in a step": (False, {**HEATNET, "alternates": False}),
    "HeatNet's with two heads": (True, {**HEATNET, "gradients": "apart"}),
    "both ways with two heads": (True, {"both_ways": True, "gradients": "together"}),
}


@pytest.mark.parametrize(("heads", "changes"), CASES.values(), ids=CASES)
def test_three_steps_of_network_and_critic(
    tmp_path: Path, heads: bool, changes: dict[str, Any]
) -> None:
    model = network(heads)
    scheme = scheme_of(model, heads, **changes)
    confidence = scheme.weighed_by_confidence
    by_hand = ByHand({**PAPERS, **changes}, heads, values_of(model), values_of(critic()))
    for pair in islice(pairs(confidence=confidence), 3):
        by_hand.step(pair)
    trained(scheme, model, tmp_path, 3, confidence)
    assert_same(model, by_hand.values)
    assert_same(scheme.others["critic"], by_hand.judge)


# ---- numbers --------------------------------------------------------------------------------


class Undecided(nn.Module):
    """A discriminator whose verdict is 0.5 everywhere."""

    def __init__(self) -> None:
        super().__init__()
        self.verdict = nn.Parameter(torch.tensor(0.5))

    def forward(self, seen: Tensor) -> Tensor:
        return self.verdict.expand(len(seen), 1, 2, 2) + 0 * seen.mean()


def parts_of(scheme: Adversarial, pair: TwoDomains) -> list[dict[str, float]]:
    return [
        {name: part.item() for name, part in phase.parts.items()}
        for phase in scheme.phases(pair.to("cpu"), generator_of)
    ]


def test_an_undecided_critic_costs_what_the_thesis_says() -> None:
    """L_d 0.5, L_adv 0.25, weighted by 0.01 0.0025 (Eqs. 5 and 6); a half of it where halved."""
    model = network(False)
    scheme = scheme_of(model, critic=Undecided(), weight=0.01)
    first, second = parts_of(scheme, next(pairs()))
    assert set(first) == {"source/ce", "target/adversarial"}
    assert first["target/adversarial"] == pytest.approx(0.0025)
    assert second == pytest.approx({"critic/source": 0.25, "critic/target": 0.25})
    _, second = parts_of(scheme_of(model, critic=Undecided(), halved=True), next(pairs()))
    assert second == pytest.approx({"critic/source": 0.125, "critic/target": 0.125})


def test_confidence_weighs_the_adversarial_cost_of_both_domains() -> None:
    scheme = scheme_of(network(False), critic=Undecided(), **{**HEATNET, "weight": 0.01})
    pair = next(pairs(confidence=True))
    target = replace(pair.target, confidence=torch.full((2, 4, 4), 0.8))
    (found,) = parts_of(scheme, replace(pair, target=target, step=1))
    assert set(found) == {"source/ce", "target/ce", "source/adversarial", "target/adversarial"}
    # A hundredth of a fifth of a quarter.
    assert found["source/adversarial"] == pytest.approx(0.0005)
    assert found["target/adversarial"] == pytest.approx(0.0005)


# ---- who steps what -------------------------------------------------------------------------


class Normalised(Linear):
    """With a normalisation, which has statistics beside its parameters."""

    def __init__(self, heads: tuple[str, ...]) -> None:
        super().__init__(heads)
        self.norm = nn.BatchNorm2d(3)

    def forward(self, rgb: Tensor, thermal: Tensor, masks: None = None, **requested: Any) -> Any:
        return super().forward(self.norm(rgb), thermal, masks, **requested)


def states(module: nn.Module) -> dict[str, Tensor]:
    return {name: each.clone() for name, each in module.state_dict().items()}


def changed(before: dict[str, Tensor], module: nn.Module) -> set[str]:
    now = module.state_dict()
    return {name for name, each in before.items() if not torch.equal(each, now[name])}


@pytest.mark.parametrize("heads", [False, True])
def test_alternating_steps_change_the_critic_and_then_the_network(
    tmp_path: Path, heads: bool
) -> None:
    """In the discriminator's steps the network runs in training mode: only its statistics go on."""
    torch.manual_seed(3)
    model = Normalised(("day", "dark") if heads else ())
    scheme = scheme_of(model, heads, **HEATNET)
    judge = scheme.others["critic"]
    made = trainer(scheme, model, tmp_path, 1)
    statistics = {"norm.running_mean", "norm.running_var", "norm.num_batches_tracked"}
    state, batches = State(seed=0), pairs(confidence=True)
    for total in range(1, 5):
        of_model, of_critic = states(model), states(judge)
        made.settings = replace(made.settings, max_steps=total)
        made.fit(batches, state)
        if total % 2:
            assert changed(of_model, model) == statistics
            assert changed(of_critic, judge) == set(CRITIC)
        else:
            assert set(dict(model.named_parameters())) <= changed(of_model, model)
            assert changed(of_critic, judge) == set()


def test_phases_of_one_step_do_not_touch_each_others_networks() -> None:
    """The segmentation leaves no gradient in the discriminator, nor the other way round."""
    for heads, changes in CASES.values():
        model = network(heads)
        scheme = scheme_of(model, heads, **changes)
        judge = scheme.others["critic"]
        pair = replace(next(pairs(confidence=True)), step=1)
        for phase in scheme.phases(pair.to("cpu"), generator_of):
            model.zero_grad()
            judge.zero_grad()
            sum(phase.parts.values()).backward()
            touched = [
                any(p.grad is not None for p in module.parameters()) for module in (model, judge)
            ]
            assert touched == ([False, True] if phase.optimizers == ("critic",) else [True, False])
        assert all(parameter.requires_grad for parameter in judge.parameters())


# ---- what does not fit ----------------------------------------------------------------------

NETWORK = network(False)
REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "no probability": ({"verdict_loss": "cross_entropy", "target_value": -1.0}, "target_value=-1"),
    "equal values": ({"target_value": 0.0}, "target_value=0"),
    "no idle steps": ({"idle_steps": "released"}, "idle_steps=released"),
}


@pytest.mark.parametrize(("changes", "sentence"), REFUSED.values(), ids=REFUSED)
def test_what_does_not_fit_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        scheme_of(NETWORK, **changes)


def test_every_pass_of_a_step_asks_for_a_generator_of_its_own() -> None:
    requested: list[str] = []

    def noting(purpose: str) -> torch.Generator:
        requested.append(purpose)
        return generator_of(purpose)

    settings = {**HEATNET, "alternates": False}
    scheme = scheme_of(network(True), True, **settings)
    list(scheme.phases(next(pairs(confidence=True)).to("cpu"), noting))
    assert requested == ["source network", "source loss", "target network", "target loss"]
    requested.clear()
    list(scheme_of(network(False)).phases(next(pairs()).to("cpu"), noting))
    assert requested == ["source network", "source loss", "target network"]
    requested.clear()
    judging = scheme_of(network(True), True, **HEATNET)  # the discriminator's step
    list(judging.phases(next(pairs(confidence=True)).to("cpu"), noting))
    assert requested == ["source network", "target network"]
