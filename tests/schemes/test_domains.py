"""Two domains, with labels or without: what a step does to every parameter, to the last digit."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.engine.checkpoint import State
from rgbt.losses.unlabelled import MaxSquares
from rgbt.schemes.supervised import Supervised
from rgbt.schemes.two_domains import LabelledDomains, UnlabelledTarget
from rgbt.types import IGNORE
from tests.schemes.linear import (
    Linear,
    Momentum,
    Nothing,
    Values,
    assert_same,
    cross_entropy,
    domains,
    generator_of,
    images,
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

DAY, DARK, ONLY = "heads.day.weight", "heads.dark.weight", "only.weight"
SHARED = "backbone.weight"


def labelled(model: Linear, heads: bool, gradients: str, **target: Any) -> LabelledDomains:
    return LabelledDomains(
        model=model,
        loss=cross_entropy,
        domains=domains(heads, **target),
        gradients=gradients,
    )


def unlabelled(model: Linear, heads: bool = False, **changes: Any) -> UnlabelledTarget:
    given: dict[str, Any] = {
        "loss": cross_entropy,
        "domains": domains(heads, labels="none"),
        "unlabelled": MaxSquares(weight=0.7, normalisation="entries", image_wise_ratio=None),
        "guidance_weight": 0.0,
        "guidance_threshold": 0.5,
    }
    return UnlabelledTarget(model=model, **{**given, **changes})


def supervised_costs(pair: Any, heads: bool) -> tuple[Callable, Callable]:
    def cost(batch: Any, view: str, head: str) -> Callable[[Values], Tensor]:
        x, y = pixels(batch, view)
        return lambda values: nats(scores(values, x, head), y)

    names = (DAY, DARK) if heads else (ONLY, ONLY)
    return cost(pair.source, "rgb", names[0]), cost(pair.target, "thermal", names[1])


def expected(model: Linear, heads: bool, mode: str, steps: int) -> Values:
    values = values_of(model)
    day = Momentum((SHARED, DAY) if heads else (SHARED, ONLY))
    dark = Momentum((SHARED, DARK)) if heads else None
    for pair in islice(pairs(), steps):
        written_out(values, mode, day, dark, *supervised_costs(pair, heads))
    return values


@pytest.mark.parametrize("mode", ["apart", "kept", "together"])
def test_two_heads_step_as_the_thesis_code(tmp_path: Path, mode: str) -> None:
    """Later steps tell whether each optimiser keeps momentum of its own for the backbone."""
    model = network(True)
    wanted = expected(model, True, mode, 3)
    log = trained(labelled(model, True, mode), model, tmp_path, 3)
    assert_same(model, wanted)
    both = ["grad_norm/source+target"]
    norms = both if mode == "together" else ["grad_norm/source", "grad_norm/target"]
    assert sorted(name for name in log[0] if name.startswith("grad_norm")) == norms
    assert {"loss/source/ce", "loss/target/ce"} <= set(log[0])
    assert {"lr/source_0", "lr/target_0"} <= set(log[0])


def test_one_head_is_one_backward_pass(tmp_path: Path) -> None:
    model = network(False)
    wanted = expected(model, False, "apart", 2)
    scheme = labelled(model, False, "apart")
    (phase,) = scheme.phases(next(pairs()).to("cpu"), generator_of)
    assert (phase.optimizers, phase.clear) == (("main",), True)
    log = trained(scheme, model, tmp_path, 2)
    assert_same(model, wanted)
    assert "grad_norm" in log[0]


def test_accumulated_phases_equal_the_mean_of_both_batches(tmp_path: Path) -> None:
    """Two batches of a step are one of their mean, phase by phase, with and without clearing."""
    for mode in ("apart", "kept", "together"):
        model = network(True)
        values, both = values_of(model), list(islice(pairs(), 2))
        day, dark = Momentum((SHARED, DAY)), Momentum((SHARED, DARK))
        each = [supervised_costs(pair, True) for pair in both]

        def mean(side: int, each: list = each) -> Callable[[Values], Tensor]:
            return lambda v: (each[0][side](v) + each[1][side](v)) / 2

        written_out(values, mode, day, dark, mean(0), mean(1))
        made = trainer(labelled(model, True, mode), model, tmp_path / mode, 1, accumulate=2)
        made.fit(pairs(), State(seed=0))
        assert_same(model, values)


def test_view_and_head_are_passed_to_the_network() -> None:
    model = network(True)
    list(labelled(model, True, "apart").phases(next(pairs()).to("cpu"), generator_of))
    assert model.calls == [(("rgb",), "day", True), (("thermal",), "dark", True)]


# ---- without labels of the target -----------------------------------------------------------


def squares(values: Values, batch: Any, weight: float) -> Tensor:
    """-weight / 2 times the mean of squared probabilities over all entries."""
    x, _ = pixels(batch, "thermal")
    return -weight / 2 * scores(values, x, ONLY).softmax(1).square().mean()


def test_maximum_squares_step(tmp_path: Path) -> None:
    model = network(False)
    values, day = values_of(model), Momentum((SHARED, ONLY))
    for pair in islice(pairs(), 2):
        source = supervised_costs(pair, False)[0]
        written_out(values, "apart", day, None, source, lambda v, p=pair: squares(v, p.target, 0.7))
    log = trained(unlabelled(model), model, tmp_path, 2)
    assert_same(model, values)
    assert {"loss/source/ce", "loss/target/max_squares"} <= set(log[0])


def test_labels_of_an_unlabelled_target_are_not_read(tmp_path: Path) -> None:
    found = []
    for label in (0, IGNORE):
        model = network(False)
        made = trainer(unlabelled(model), model, tmp_path / str(label), 1)
        pair = next(pairs())
        pair.target.label.fill_(label)
        made.fit(iter([pair]), State(seed=0))
        found.append(values_of(model))
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])


def test_guidance_trains_the_auxiliary_head_alone_and_what_is_below(tmp_path: Path) -> None:
    """Its label is no function of the scores: the head that gives it gets no gradient."""
    model = network(False, auxiliary=True)
    scheme = unlabelled(model, guidance_weight=0.25, guidance_threshold=0.4)
    pair = next(pairs()).to("cpu")
    (phase,) = scheme.phases(pair, generator_of)
    parts = phase.parts
    assert set(parts) == {"source/ce", "target/max_squares", "target/guidance"}
    parts["target/guidance"].backward()
    assert model.only.weight.grad is None
    assert model.auxiliary.weight.grad is not None
    assert model.backbone.weight.grad is not None

    values = values_of(model)
    x = pixels(next(pairs()).target, "thermal")[0]
    main, aux = (scores(values, x, name).softmax(1) for name in (ONLY, "auxiliary.weight"))
    sure = (main.amax(1) > 0.4) | (aux.amax(1) > 0.4)
    assert 0 < sure.sum() < len(x)
    label = (main + aux).argmax(1)
    cost = 0.25 * nats(scores(values, x, "auxiliary.weight")[sure], label[sure])
    assert parts["target/guidance"].item() == pytest.approx(cost.item(), rel=1e-5)


def test_guidance_of_nothing_sure_costs_nothing() -> None:
    model = network(False, auxiliary=True)
    scheme = unlabelled(model, guidance_weight=1.0, guidance_threshold=0.999)
    (phase,) = scheme.phases(next(pairs()).to("cpu"), generator_of)
    assert phase.parts["target/guidance"].item() == 0.0
    phase.parts["target/guidance"].backward()
    assert model.auxiliary.weight.grad.abs().sum() == 0


# ---- what is required -----------------------------------------------------------------------


def test_supervised_shows_the_domain_to_its_head() -> None:
    model = network(True)
    given = domains(True)
    alone = replace(given, target=None, target_is=None)
    scheme = Supervised(model=model, loss=cross_entropy, masker=Nothing(), domains=alone)
    (phase,) = scheme.phases(images("source", 0).to("cpu"), generator_of)
    assert model.calls == [(("rgb",), "day", True)]
    assert phase.optimizers == ("main",)
