"""Two domains: what a step does to every parameter, to the last digit, and who steps what."""

from __future__ import annotations

from dataclasses import replace
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
from tests.schemes.linear import LR, MOMENTUM, K, Linear, network, pairs

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
        "guidance_weight": 0.0,
        "guidance_threshold": 0.5,
    }
    return UnlabelledTarget(model=model, **{**given, **changes})


def costs_of(model: Linear, pair: TwoDomains, heads: bool) -> dict[str, float]:
    """Cross-entropies of both domains, of what each sees."""
    values, found = linear.values_of(model), {}
    names = (DAY, DARK) if heads else (ONLY, ONLY)
    for domain, view, head in zip(("source", "target"), ("rgb", "thermal"), names, strict=True):
        x, y = linear.pixels(getattr(pair, domain), view)
        found[f"{domain}/ce"] = linear.nats(linear.scores(values, x, head), y).item()
    return found


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("apart", [(("source",), True), (("target",), True)]),
        ("kept", [(("source",), True), (("target",), False)]),
        ("together", [(("source", "target"), True)]),
    ],
)
def test_two_heads_step_as_the_thesis_code(mode: str, expected: list[tuple[Any, bool]]) -> None:
    """One optimizer each, of all but the other's head; the loop steps them phase by phase."""
    model, pair = network(True), pair_at()
    scheme = labelled(model, True, mode)
    assert scheme.record.optimizers == {"source": ("heads.dark.",), "target": ("heads.day.",)}
    phases = phases_of(scheme, pair)
    assert [(phase.optimizers, phase.clear) for phase in phases] == expected
    parts = {name: part.item() for phase in phases for name, part in phase.parts.items()}
    assert parts == pytest.approx(costs_of(model, pair, True), rel=1e-5)
    assert model.calls == [(("rgb",), "day", True), (("thermal",), "dark", True)]


def test_maximum_squares_step_reads_no_label_of_the_target() -> None:
    """-weight / 2 times the mean of squared probabilities over all entries."""
    model, pair = network(False), pair_at()
    expected = costs_of(model, pair, False)
    pair.target.label.fill_(IGNORE)
    (phase,) = phases_of(unlabelled(model), pair)
    assert (phase.optimizers, phase.clear) == (("main",), True)
    z = linear.scores(linear.values_of(model), linear.pixels(pair.target, "thermal")[0], ONLY)
    squares = -0.7 / 2 * z.softmax(1).square().mean()
    assert set(phase.parts) == {"source/ce", "target/max_squares"}
    assert phase.parts["source/ce"].item() == pytest.approx(expected["source/ce"], rel=1e-5)
    assert phase.parts["target/max_squares"].item() == pytest.approx(squares.item(), rel=1e-5)


def test_guidance_trains_only_auxiliary_head_and_layers_below() -> None:
    """Its label is no function of the scores: the head that gives it gets no gradient."""
    model, pair = network(False, auxiliary=True), pair_at()
    (phase,) = phases_of(unlabelled(model, guidance_weight=0.25, guidance_threshold=0.4), pair)
    assert set(phase.parts) == {"source/ce", "target/max_squares", "target/guidance"}
    phase.parts["target/guidance"].backward()
    assert model.only.weight.grad is None
    assert model.auxiliary.weight.grad is not None
    assert model.backbone.weight.grad is not None

    values, names = linear.values_of(model), (ONLY, "auxiliary.weight")
    x = linear.pixels(pair.target, "thermal")[0]
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


def test_networks_without_class_scores_learn_labels_of_two_domains() -> None:
    """Such as Mask2Former; its loss reads masks."""
    model = network(False)
    for scheme in (labelled(model, False, "apart"), unlabelled(model)):
        required = {rule.key for rule in scheme.record.requires}
        assert ("outputs" in required) == isinstance(scheme, UnlabelledTarget)


# ---- adversarial: the same by matrices -----------------------------------------------------------

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
    "judged": "logits",
    "source_value": 1.0,
    "target_value": 0.0,
    "both_ways": True,
    "weighed_by_confidence": True,
    "supervise_target": True,
    "alternates": True,
}


def critic() -> nn.Conv2d:
    torch.manual_seed(5)
    return nn.Conv2d(K, 1, 1)


def scheme_of(model: nn.Module, heads: bool = False, **changes: Any) -> Adversarial:
    settings = {**PAPERS, **changes}
    confidence = settings["weighed_by_confidence"]
    labels = "/pseudo" if settings["supervise_target"] or confidence else "none"
    sgd = SGD(lr=LR, backbone_multiplier=1.0, momentum=MOMENTUM, weight_decay=0.0)
    given: dict[str, Any] = {
        "loss": linear.cross_entropy,
        "domains": linear.domains(heads, labels=labels, confidence=confidence),
        "critic": critic(),
        "critic_optimizer": sgd,
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
def test_parts_of_both_phases_by_their_formulas(heads: bool, changes: dict[str, Any]) -> None:
    model, given = network(heads), {**PAPERS, **changes}
    scheme = scheme_of(model, heads, **changes)
    values, judge = linear.values_of(model), linear.values_of(scheme.others["critic"])
    pair = pair_at(confidence=scheme.weighed_by_confidence)
    weight = given["weight"]
    if given["weighed_by_confidence"]:
        weight = weight * (1 - pair.target.confidence.double()).mean()
    numbers = {name: given[f"{name}_value"] for name in ("source", "target")}
    expected: dict[str, Tensor] = {}
    for name, other, view, head in (
        ("source", "target", "rgb", DAY if heads else ONLY),
        ("target", "source", "thermal", DARK if heads else ONLY),
    ):
        x, y = linear.pixels(getattr(pair, name), view)
        z = linear.scores(values, x, head)
        verdicts = shown(z, given["judged"]) @ judge["weight"].T + judge["bias"]
        cost, wrong = (
            distance(verdicts, numbers[domain], given["verdict_loss"]) for domain in (name, other)
        )
        if name == "source" or given["supervise_target"]:
            expected[f"{name}/ce"] = linear.nats(z, y)
        if name == "target" or given["both_ways"]:
            expected[f"{name}/adversarial"] = weight * wrong
        expected[f"critic/{name}"] = (0.5 if given["halved"] else 1.0) * cost
    steps = (0, 1) if given["alternates"] else (0,)
    phases = [phase for step in steps for phase in phases_of(scheme, replace(pair, step=step))]
    found = {name: part for phase in phases for name, part in phase.parts.items()}
    assert found.keys() == expected.keys()
    for name, part in found.items():
        assert part.item() == pytest.approx(expected[name].item(), rel=1e-5), name


@BY_CASE
def test_phases_of_step_do_not_share_trained_networks(heads: bool, changes: dict[str, Any]) -> None:
    """The segmentation leaves no gradient in the discriminator, nor the other way round."""
    model = network(heads)
    scheme = scheme_of(model, heads, **changes)
    both = (model, scheme.others["critic"])
    for phase in scheme.phases(pair_at(1, confidence=True), linear.generator_of):
        for module in both:
            module.zero_grad()
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
    return {name for name, value in before.items() if not torch.equal(value, now[name])}


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
        states = [{k: v.clone() for k, v in module.state_dict().items()} for module in both]
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
        (
            {"verdict_loss": "cross_entropy", "target_value": -1.0},
            "source_value=0, target_value=-1",
        ),
        ({"target_value": 0.0}, "target_value=0"),
        ({"idle_steps": "released"}, "idle_steps=released"),
    ],
)
def test_what_does_not_fit_is_refused(changes: dict[str, Any], sentence: str) -> None:
    with pytest.raises(InputError, match=sentence):
        scheme_of(network(False), **changes)


SWITCHES = ("both_ways", "weighed_by_confidence", "halved", "supervise_target", "alternates")


@pytest.mark.parametrize("alone", SWITCHES)
def test_each_switch_alone_requires_its_own(alone: str) -> None:
    switches = {name: name == alone for name in SWITCHES}
    required = {
        need.key: need.value
        for need in scheme_of(network(False), **switches).record.requires
        if need.key in ("target_labels", "target_confidence")
    }
    confidence = {"target_confidence": True} if alone == "weighed_by_confidence" else {}
    assert required == {"target_labels": alone == "supervise_target", **confidence}
    if alone == "alternates":
        scheme_of(network(False), **switches, idle_steps="released")
    else:
        with pytest.raises(InputError, match=r"idle_steps=released requires"):
            scheme_of(network(False), **switches, idle_steps="released")


SOURCE = ("source network", "source loss")


@pytest.mark.parametrize(
    ("heads", "changes", "expected"),
    [
        (True, {**HEATNET, "alternates": False}, [*SOURCE, "target network", "target loss"]),
        (False, {}, [*SOURCE, "target network"]),
        (True, HEATNET, ["source network", "target network"]),  # the discriminator's step
    ],
)
def test_every_pass_of_a_step_has_its_own_generator(
    heads: bool, changes: dict[str, Any], expected: list[str]
) -> None:
    requested: list[str] = []

    def noting(purpose: str) -> torch.Generator:
        requested.append(purpose)
        return linear.generator_of(purpose)

    list(scheme_of(network(heads), heads, **changes).phases(pair_at(0, confidence=True), noting))
    assert requested == expected


# ---- HeatNet's one RMSprop for two networks ------------------------------------------------------


def test_idle_optimizers_decay_mean_squares_and_move_nothing(tmp_path: Path) -> None:
    """Of three alternating steps, the network's is the second one, and idle in the third."""
    found = {}
    for idle_steps in ("none", "released"):
        model, builder = network(False), RMSprop(lr=0.01, alpha=0.9, eps=1e-8)
        changes: dict[str, Any] = {**HEATNET, "critic_optimizer": builder}
        scheme = scheme_of(model, **{**changes, "idle_steps": idle_steps})
        made = linear.trainer(scheme, model, tmp_path / idle_steps, 3)
        made.optimizers = {"main": builder(model), "critic": builder(scheme.others["critic"])}
        made.fit(pairs(confidence=True), State(seed=0))
        states = made.optimizers["main"].state
        found[idle_steps] = (
            linear.values_of(model),
            [moments["square_avg"] for moments in states.values()],
        )
    (values, squares), (same, decayed) = found["none"], found["released"]
    assert all(torch.equal(values[name], same[name]) for name in values)
    assert len(squares) == 2
    for before, after in zip(squares, decayed, strict=True):
        torch.testing.assert_close(after, 0.9 * before)


@pytest.mark.parametrize(
    ("step", "idle_steps", "idle"),
    [(0, "none", ()), (1, "none", ()), (0, "released", ("main",)), (1, "released", ("critic",))],
)
def test_phases_name_the_idle_optimizers_of_the_released_form(
    step: int, idle_steps: str, idle: tuple[str, ...]
) -> None:
    scheme = scheme_of(network(False), **{**HEATNET, "idle_steps": idle_steps})
    assert [phase.idle for phase in phases_of(scheme, pair_at(step, confidence=True))] == [idle]
