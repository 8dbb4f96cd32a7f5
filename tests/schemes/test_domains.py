"""Two domains: what a step does to every parameter, to the last digit, and who steps what."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from itertools import islice
from math import log
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import State
from rgbt.engine.optimizers import SGD, RMSprop
from rgbt.losses.unlabelled import MaxSquares
from rgbt.schemes.adversarial import Adversarial
from rgbt.schemes.supervised import Supervised
from rgbt.schemes.two_domains import LabelledDomains, UnlabelledTarget
from rgbt.types import IGNORE, TwoDomains
from tests.schemes import linear
from tests.schemes.linear import LR, MOMENTUM, Cost, K, Linear, Momentum, Values, network, pairs

DAY, DARK, ONLY, SHARED = "heads.day.weight", "heads.dark.weight", "only.weight", "backbone.weight"
CRITIC = ("weight", "bias")


def pair_at(step: int = 0, confidence: bool = False) -> TwoDomains:
    return replace(next(pairs(confidence=confidence)).to("cpu"), step=step)


def phases_of(scheme: Any, pair: TwoDomains) -> list[Any]:
    return list(scheme.phases(pair, linear.generator_of))


# ---- labels of both, or of the source alone ------------------------------------------------------


def labelled(model: Linear, heads: bool, gradients: str, **target: Any) -> LabelledDomains:
    return LabelledDomains(
        model=model,
        loss=linear.cross_entropy,
        domains=linear.domains(heads, **target),
        gradients=gradients,
    )


def unlabelled(model: Linear, heads: bool = False, **changes: Any) -> UnlabelledTarget:
    given: dict[str, Any] = {
        "loss": linear.cross_entropy,
        "domains": linear.domains(heads, labels="none"),
        "unlabelled": MaxSquares(weight=0.7, normalisation="entries", image_wise_ratio=None),
        **{"guidance_weight": 0.0, "guidance_threshold": 0.5},
    }
    return UnlabelledTarget(model=model, **{**given, **changes})


def supervised_costs(pair: Any, heads: bool) -> tuple[Cost, Cost]:
    def cost(batch: Any, view: str, head: str) -> Cost:
        x, y = linear.pixels(batch, view)
        return lambda values: linear.nats(linear.scores(values, x, head), y)

    names = (DAY, DARK) if heads else (ONLY, ONLY)
    return cost(pair.source, "rgb", names[0]), cost(pair.target, "thermal", names[1])


def stepped(heads: bool) -> tuple[Momentum, Momentum | None]:
    day = Momentum((SHARED, DAY) if heads else (SHARED, ONLY))
    return day, Momentum((SHARED, DARK)) if heads else None


@pytest.mark.parametrize("mode", ["apart", "kept", "together"])
def test_two_heads_step_as_the_thesis_code(tmp_path: Path, mode: str) -> None:
    """Later steps tell whether each optimiser keeps momentum of its own for the backbone."""
    model, optimizers = network(True), stepped(True)
    values = linear.values_of(model)
    for pair in islice(pairs(), 3):
        linear.written_out(values, mode, *optimizers, *supervised_costs(pair, True))
    log = linear.trained(labelled(model, True, mode), model, tmp_path, 3)
    linear.assert_same(model, values)
    assert model.calls[:2] == [(("rgb",), "day", True), (("thermal",), "dark", True)]
    norms = ["source+target"] if mode == "together" else ["source", "target"]
    found = sorted(name for name in log[0] if name.startswith("grad_norm"))
    assert found == [f"grad_norm/{name}" for name in norms]
    assert {"loss/source/ce", "loss/target/ce", "lr/source_0", "lr/target_0"} <= set(log[0])


def test_one_head_is_one_backward_pass(tmp_path: Path) -> None:
    model, optimizers = network(False), stepped(False)
    values = linear.values_of(model)
    for pair in islice(pairs(), 2):
        linear.written_out(values, "apart", *optimizers, *supervised_costs(pair, False))
    scheme = labelled(model, False, "apart")
    (phase,) = phases_of(scheme, pair_at())
    assert (phase.optimizers, phase.clear) == (("main",), True)
    assert "grad_norm" in linear.trained(scheme, model, tmp_path, 2)[0]
    linear.assert_same(model, values)


@pytest.mark.parametrize("mode", ["apart", "kept", "together"])
def test_accumulated_phases_equal_the_mean_of_both_batches(tmp_path: Path, mode: str) -> None:
    """Two batches of a step are one of their mean, phase by phase, with and without clearing."""
    model = network(True)
    values = linear.values_of(model)
    each = [supervised_costs(pair, True) for pair in islice(pairs(), 2)]

    def mean(side: int) -> Cost:
        return lambda v: (each[0][side](v) + each[1][side](v)) / 2

    linear.written_out(values, mode, *stepped(True), mean(0), mean(1))
    made = linear.trainer(labelled(model, True, mode), model, tmp_path, 1, accumulate=2)
    made.fit(pairs(), State(seed=0))
    linear.assert_same(model, values)


def test_maximum_squares_step_reads_no_label_of_the_target(tmp_path: Path) -> None:
    """-weight / 2 times the mean of squared probabilities over all entries."""

    def squares(values: Values, batch: Any) -> Tensor:
        x, _ = linear.pixels(batch, "thermal")
        return -0.7 / 2 * linear.scores(values, x, ONLY).softmax(1).square().mean()

    model, optimizers = network(False), stepped(False)
    values = linear.values_of(model)
    batches = list(islice(pairs(), 2))
    for pair in batches:
        source = supervised_costs(pair, False)[0]
        target = lambda v, p=pair: squares(v, p.target)  # noqa: E731
        linear.written_out(values, "apart", *optimizers, source, target)
        pair.target.label.fill_(IGNORE)
    made = linear.trainer(unlabelled(model), model, tmp_path, 2)
    made.fit(iter(batches), State(seed=0))
    linear.assert_same(model, values)
    assert {"loss/source/ce", "loss/target/max_squares"} <= set(made.log[0])


def test_guidance_trains_the_auxiliary_head_alone_and_what_is_below() -> None:
    """Its label is no function of the scores: the head that gives it gets no gradient."""
    model, pair = network(False, auxiliary=True), pair_at()
    (phase,) = phases_of(unlabelled(model, guidance_weight=0.25, guidance_threshold=0.4), pair)
    assert set(phase.parts) == {"source/ce", "target/max_squares", "target/guidance"}
    phase.parts["target/guidance"].backward()
    assert model.only.weight.grad is None
    assert model.auxiliary.weight.grad is not None
    assert model.backbone.weight.grad is not None

    values, names = linear.values_of(model), (ONLY, "auxiliary.weight")
    x = linear.pixels(next(pairs()).target, "thermal")[0]
    main, aux = (linear.scores(values, x, name).softmax(1) for name in names)
    sure = (main.amax(1) > 0.4) | (aux.amax(1) > 0.4)
    assert 0 < sure.sum() < len(x)
    cost = linear.nats(linear.scores(values, x, names[1])[sure], (main + aux).argmax(1)[sure])
    assert phase.parts["target/guidance"].item() == pytest.approx(0.25 * cost.item(), rel=1e-5)
    # Where nothing is sure, it costs nothing.
    (phase,) = phases_of(unlabelled(model, guidance_weight=1.0, guidance_threshold=0.999), pair)
    assert phase.parts["target/guidance"].item() == 0.0


def test_supervised_shows_the_domain_to_its_head() -> None:
    model = network(True)
    alone = replace(linear.domains(True), target=None, target_is=None)
    given = {"model": model, "loss": linear.cross_entropy, "masker": linear.Nothing()}
    (phase,) = phases_of(Supervised(**given, domains=alone), linear.images("source", 0).to("cpu"))
    assert model.calls == [(("rgb",), "day", True)]
    assert phase.optimizers == ("main",)


# ---- adversarial: the same by matrices -----------------------------------------------------------

PAPERS: dict[str, Any] = {
    **{"judged": "probabilities", "verdict_loss": "least_squares", "source_value": 0.0},
    **{"target_value": 1.0, "weight": 0.4, "both_ways": False, "weighed_by_confidence": False},
    **{"halved": False, "supervise_target": False, "alternates": False, "gradients": "apart"},
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
    sgd = SGD(lr=LR, backbone_multiplier=1.0, momentum=MOMENTUM, weight_decay=0.0)
    given: dict[str, Any] = {
        "loss": linear.cross_entropy,
        "domains": linear.domains(heads, labels=labels, confidence=confidence),
        **{"critic": critic(), "critic_optimizer": sgd},
    }
    return Adversarial(model=model, **{**given, **settings})


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
        names = (DAY, DARK) if self.heads else (ONLY, ONLY)
        self.names = dict(zip(("source", "target"), names, strict=True))
        self.day, self.dark = stepped(self.heads)
        self.of_critic = Momentum(CRITIC)

    def verdicts(self, seen: Tensor, judge: Values) -> Tensor:
        return seen @ judge["weight"].T + judge["bias"]

    def cost_of(self, pair: TwoDomains, name: str) -> Cost:
        """Segmentation and adversarial cost of a domain."""
        given, judge = self.settings, dict(self.judge)
        batch, view = (pair.source, "rgb") if name == "source" else (pair.target, "thermal")
        x, y = linear.pixels(batch, view)
        wrong = given["target_value" if name == "source" else "source_value"]
        weight = given["weight"]
        if given["weighed_by_confidence"]:
            weight = weight * (1 - pair.target.confidence.double()).mean()

        def cost(values: Values) -> Tensor:
            z = linear.scores(values, x, self.names[name])
            found = torch.zeros((), dtype=torch.float64)
            if name == "source" or given["supervise_target"]:
                found = found + linear.nats(z, y)
            if name == "target" or given["both_ways"]:
                verdicts = self.verdicts(shown(z, given["judged"]), judge)
                found = found + weight * distance(verdicts, wrong, given["verdict_loss"])
            return found

        return cost

    def critic_step(self, pair: TwoDomains, at: tuple[Values, Values]) -> None:
        given = self.settings
        maps = [
            shown(
                linear.scores(values, linear.pixels(batch, view)[0], self.names[name]),
                given["judged"],
            )
            for values, batch, view, name in (
                (at[0], pair.source, "rgb", "source"),
                (at[1], pair.target, "thermal", "target"),
            )
        ]
        wanted = (given["source_value"], given["target_value"])

        def cost(judge: Values) -> Tensor:
            costs = [
                distance(self.verdicts(seen, judge), value, given["verdict_loss"])
                for seen, value in zip(maps, wanted, strict=True)
            ]
            return (0.5 if given["halved"] else 1.0) * (costs[0] + costs[1])

        self.of_critic.step(self.judge, linear.gradient(cost, self.judge))

    def step(self, pair: TwoDomains) -> None:
        if self.settings["alternates"] and pair.step % 2 == 0:
            self.critic_step(pair, (self.values, self.values))
            return
        costs = self.cost_of(pair, "source"), self.cost_of(pair, "target")
        mode = self.settings["gradients"]
        at = linear.written_out(self.values, mode, self.day, self.dark, *costs)
        if not self.settings["alternates"]:
            self.critic_step(pair, at)


LOGISTIC = {"verdict_loss": "cross_entropy", "halved": True}
UNPAIRED = {**HEATNET, "weighed_by_confidence": False, "supervise_target": False}
CASES: dict[str, tuple[bool, dict[str, Any]]] = {
    "thesis, Eqs. 4 to 6, one head": (False, {}),
    "thesis, two heads": (True, {}),
    "thesis' code, second stage": (True, {"gradients": "together"}),
    "thesis' code, basic": (True, {"gradients": "kept", "supervise_target": True}),
    "thesis' code, one head": (False, {"supervise_target": True}),
    "AdaptSegNet": (False, LOGISTIC),
    "ADVENT": (False, {"judged": "self_information", **LOGISTIC}),
    "HeatNet": (False, HEATNET),
    "HeatNet without teacher": (False, UNPAIRED),
    "HeatNet, both phases in a step": (False, {**HEATNET, "alternates": False}),
    "HeatNet's with two heads": (True, HEATNET),
    "both ways with two heads": (True, {"both_ways": True, "gradients": "together"}),
}
BY_CASE = pytest.mark.parametrize(("heads", "changes"), CASES.values(), ids=CASES)


@BY_CASE
def test_three_steps_of_network_and_critic(
    tmp_path: Path, heads: bool, changes: dict[str, Any]
) -> None:
    model = network(heads)
    scheme = scheme_of(model, heads, **changes)
    confidence = scheme.weighed_by_confidence
    values = linear.values_of(model), linear.values_of(critic())
    by_hand = ByHand({**PAPERS, **changes}, heads, *values)
    for pair in islice(pairs(confidence=confidence), 3):
        by_hand.step(pair)
    linear.trained(scheme, model, tmp_path, 3, confidence)
    linear.assert_same(model, by_hand.values)
    linear.assert_same(scheme.others["critic"], by_hand.judge)


@BY_CASE
def test_phases_of_one_step_do_not_touch_each_others_networks(
    heads: bool, changes: dict[str, Any]
) -> None:
    """The segmentation leaves no gradient in the discriminator, nor the other way round."""
    model = network(heads)
    scheme = scheme_of(model, heads, **changes)
    both = (model, scheme.others["critic"])
    for phase in scheme.phases(pair_at(1, confidence=True), linear.generator_of):
        for each in both:
            each.zero_grad()
        sum(phase.parts.values()).backward()
        touched = [any(p.grad is not None for p in module.parameters()) for module in both]
        assert touched == ([False, True] if phase.optimizers == ("critic",) else [True, False])
    assert all(parameter.requires_grad for parameter in both[1].parameters())


class Undecided(nn.Module):
    """A discriminator whose verdict is 0.5 everywhere."""

    def __init__(self) -> None:
        super().__init__()
        self.verdict = nn.Parameter(torch.tensor(0.5))

    def forward(self, seen: Tensor) -> Tensor:
        return self.verdict.expand(len(seen), 1, 2, 2) + 0 * seen.mean()


def parts_of(pair: TwoDomains, **changes: Any) -> list[dict[str, float]]:
    phases = phases_of(scheme_of(network(False), critic=Undecided(), **changes), pair)
    return [{name: part.item() for name, part in phase.parts.items()} for phase in phases]


def test_an_undecided_critic_costs_what_the_thesis_says() -> None:
    """L_d 0.5, L_adv 0.25, weighted by 0.01 0.0025 (Eqs. 5 and 6); a half of it where halved."""
    first, second = parts_of(pair_at(), weight=0.01)
    assert set(first) == {"source/ce", "target/adversarial"}
    assert first["target/adversarial"] == pytest.approx(0.0025)
    assert second == pytest.approx({"critic/source": 0.25, "critic/target": 0.25})
    _, second = parts_of(pair_at(), halved=True)
    assert second == pytest.approx({"critic/source": 0.125, "critic/target": 0.125})


def test_confidence_weighs_the_adversarial_cost_of_both_domains() -> None:
    """A hundredth of a fifth of a quarter."""
    pair = pair_at(1, confidence=True)
    target = replace(pair.target, confidence=torch.full((2, 4, 4), 0.8))
    (found,) = parts_of(replace(pair, target=target), **{**HEATNET, "weight": 0.01})
    assert set(found) == {"source/ce", "target/ce", "source/adversarial", "target/adversarial"}
    assert found["source/adversarial"] == pytest.approx(0.0005)
    assert found["target/adversarial"] == pytest.approx(0.0005)


class Normalised(Linear):
    """With a normalisation, which has statistics beside its parameters."""

    def __init__(self, heads: tuple[str, ...]) -> None:
        super().__init__(heads)
        self.norm = nn.BatchNorm2d(3)

    def forward(self, rgb: Tensor, thermal: Tensor, masks: None = None, **requested: Any) -> Any:
        return super().forward(self.norm(rgb), thermal, masks, **requested)


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
    both = (model, scheme.others["critic"])
    made = linear.trainer(scheme, model, tmp_path, 1)
    statistics = {"norm.running_mean", "norm.running_var", "norm.num_batches_tracked"}
    state, batches = State(seed=0), pairs(confidence=True)
    for total in range(1, 5):
        states = [{k: v.clone() for k, v in each.state_dict().items()} for each in both]
        made.settings = replace(made.settings, max_steps=total)
        made.fit(batches, state)
        of_model, of_critic = map(changed, states, both)
        if total % 2:
            assert (of_model, of_critic) == (statistics, set(CRITIC))
        else:
            assert set(dict(model.named_parameters())) <= of_model
            assert of_critic == set()


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"verdict_loss": "cross_entropy", "target_value": -1.0}, "target_value=-1"),
        ({"target_value": 0.0}, "target_value=0"),
        ({"idle_steps": "released"}, "idle_steps=released"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        scheme_of(network(False), **changes)


SOURCE = ("source network", "source loss")


@pytest.mark.parametrize(
    ("heads", "changes", "expected"),
    [
        (True, {**HEATNET, "alternates": False}, [*SOURCE, "target network", "target loss"]),
        (False, {}, [*SOURCE, "target network"]),
        (True, HEATNET, ["source network", "target network"]),  # the discriminator's step
    ],
)
def test_every_pass_of_a_step_asks_for_a_generator_of_its_own(
    heads: bool, changes: dict[str, Any], expected: list[str]
) -> None:
    requested: list[str] = []

    def noting(purpose: str) -> torch.Generator:
        requested.append(purpose)
        return linear.generator_of(purpose)

    list(scheme_of(network(heads), heads, **changes).phases(pair_at(0, confidence=True), noting))
    assert requested == expected


# ---- HeatNet's one RMSprop for two networks ------------------------------------------------------

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


@pytest.mark.parametrize("idle_steps", ["none", "released"])
@pytest.mark.parametrize("stop", [0, 3])
def test_seven_alternating_steps_are_those_written_out(
    tmp_path: Path, idle_steps: str, stop: int
) -> None:
    """Also where they are resumed; the released optimizer decays what the idle network has."""
    values = linear.values_of(network(False)), linear.values_of(critic())
    expected = ByHand(HEATNET, False, *values)
    of_network, of_critic = MeanSquares((SHARED, ONLY)), MeanSquares(CRITIC)
    expected.day, expected.of_critic = of_network, of_critic  # type: ignore[assignment]
    for pair in islice(pairs(confidence=True), 7):
        expected.step(pair)
        if idle_steps == "released":
            (of_network if pair.step % 2 == 0 else of_critic).decay()

    model, builder = network(False), RMSprop(lr=RATE, alpha=ALPHA, eps=EPS)
    settings: dict[str, Any] = {**HEATNET, "idle_steps": idle_steps}
    scheme = scheme_of(model, critic_optimizer=builder, **settings)
    for first, last in ((0, stop), (stop, 7)) if stop else ((0, 7),):
        made = linear.trainer(scheme, model, tmp_path, last, checkpoint_every=1)
        made.optimizers = {"main": builder(model), "critic": builder(scheme.others["critic"])}
        state = State(seed=0)
        assert made.resume(state) == bool(first)
        made.fit(pairs(first, confidence=True), state)
    linear.assert_same(model, expected.values)
    linear.assert_same(scheme.others["critic"], expected.judge)


@pytest.mark.parametrize(
    ("step", "idle_steps", "idle"),
    [(0, "none", ()), (1, "none", ()), (0, "released", ("main",)), (1, "released", ("critic",))],
)
def test_phases_name_the_idle_optimizers_of_the_released_form(
    step: int, idle_steps: str, idle: tuple[str, ...]
) -> None:
    scheme = scheme_of(network(False), **{**HEATNET, "idle_steps": idle_steps})
    assert [phase.idle for phase in phases_of(scheme, pair_at(step, confidence=True))] == [idle]
