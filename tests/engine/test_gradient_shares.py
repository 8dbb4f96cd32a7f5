"""Share of the gradient by loss term: by hand, in every kind of step, and without any effect."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.engine.checkpoint import State
from rgbt.engine.gradient_shares import (
    TermGradients,
    gradient_ratio,
    gradient_share,
    shares_sentence,
)
from rgbt.engine.settings import TrainerSettings
from rgbt.types import GeneratorOf, Phase
from tests.commands import Call, logged, only_run, train
from tests.engine.test_trainer import SETTINGS, batches, halves, make, make_two
from tests.processes import run_in_processes
from tests.schemes.linear import network, pairs, trainer
from tests.schemes.test_adversarial import HEATNET, PAPERS, scheme_of

ON = {"log_gradient_shares": True}
MEASURED = ("images_per_s", "wait_share", "peak_memory_mib", "gradient_share", "gradient_ratio")
"""Beginnings of what may differ between a run that measures shares and one that does not."""


def by_hand(*directions: tuple[float, float]) -> tuple[dict[str, float], nn.Parameter]:
    """Shares of terms whose gradients are these."""
    weight, frozen = nn.Parameter(torch.ones(2)), nn.Parameter(torch.ones(2), requires_grad=False)
    terms = TermGradients([weight, frozen], Tensor.backward)
    parts = {f"t{n}": (weight * torch.tensor(each)).sum() for n, each in enumerate(directions)}
    terms.add(parts, 1.0)
    return terms.shares(""), weight


def test_two_terms_at_a_right_angle_by_hand() -> None:
    """(3, 0) and (0, 4): the sum is (3, 4), of length 5."""
    shares, weight = by_hand((3.0, 0.0), (0.0, 4.0))
    assert shares == pytest.approx(
        {
            **{"gradient_share/t0": 9 / 25, "gradient_share/t1": 16 / 25},
            **{"gradient_ratio/t0": 3 / 5, "gradient_ratio/t1": 4 / 5},
        }
    )
    assert weight.grad is None


def test_opposed_term_has_a_negative_share() -> None:
    """(3, 0), (0, 4) and (-1, 0): the sum is (2, 4), whose square is 20."""
    shares, _ = by_hand((3.0, 0.0), (0.0, 4.0), (-1.0, 0.0))
    found = [shares[gradient_share(f"t{n}")] for n in range(3)]
    assert found == pytest.approx([6 / 20, 16 / 20, -2 / 20])
    assert sum(found) == pytest.approx(1.0)
    sizes = [shares[gradient_ratio(f"t{n}")] for n in range(3)]
    assert sizes == pytest.approx([3 / math.sqrt(20), 4 / math.sqrt(20), 1 / math.sqrt(20)])


@pytest.mark.parametrize(
    "directions", [[(0.0, 0.0)], [(1.0, 2.0), (-1.0, -2.0)], [(math.nan, 1.0)]]
)
def test_without_a_gradient_there_are_no_shares(directions: list[tuple[float, float]]) -> None:
    assert by_hand(*directions)[0] == {}


def test_a_constant_term_has_no_share_of_the_gradient() -> None:
    weight = nn.Parameter(torch.ones(2))
    terms = TermGradients([weight], Tensor.backward)
    terms.add({"fit": weight.sum(), "constant": torch.tensor(7.0)}, 1.0)
    assert terms.shares("") == {
        **{"gradient_share/fit": 1.0, "gradient_share/constant": 0.0},
        **{"gradient_ratio/fit": 1.0, "gradient_ratio/constant": 0.0},
    }


def test_accumulated_batches_are_one_gradient() -> None:
    """Half of (2, 0) and of (0, 2) for the first term; half of (0, 2) twice for the second."""
    weight = nn.Parameter(torch.ones(2))
    terms = TermGradients([weight], Tensor.backward)
    for first, second in (((2.0, 0.0), (0.0, 2.0)), ((0.0, 2.0), (0.0, 2.0))):
        parts = {
            "a": (weight * torch.tensor(first)).sum(),
            "b": (weight * torch.tensor(second)).sum(),
        }
        terms.add(parts, 0.5)
    shares = terms.shares("")  # (1, 1) and (0, 2): the sum is (1, 3)
    assert shares[gradient_share("a")] == pytest.approx(4 / 10)
    assert shares[gradient_share("b")] == pytest.approx(6 / 10)
    assert shares[gradient_ratio("b")] == pytest.approx(2 / math.sqrt(10))


def unmeasured(log: list[tuple[int, dict[str, float]]]) -> list[dict[str, float]]:
    return [{k: v for k, v in line.items() if not k.startswith(MEASURED)} for _, line in log]


def assert_no_effect(make_one: Callable[..., Any], data: Callable[[], Iterator[Any]]) -> list[Any]:
    """Train with and without; every logged value and weight is the same. The log with shares."""
    logs, weights = [], []
    for settings in ({}, ON):
        trainer, log = make_one(settings)
        trainer.fit(data(), State(seed=7))
        logs.append(log)
        modules = (trainer.model, *trainer.others.values())
        weights.append([v.clone() for each in modules for v in each.state_dict().values()])
    assert unmeasured(logs[0]) == unmeasured(logs[1])
    assert all(torch.equal(a, b) for a, b in zip(*weights, strict=True))
    assert not any(key.startswith("gradient_") for _, line in logs[0] for key in line)
    return logs[1]


@pytest.mark.parametrize("accumulate", [1, 2])
def test_losses_and_weights_are_the_same_bits(tmp_path: Path, accumulate: int) -> None:
    log = assert_no_effect(
        lambda more: make(tmp_path / f"{more}", accumulate=accumulate, **more),
        halves if accumulate == 2 else lambda: batches(0),
    )
    assert all(line[gradient_share("fit")] == 1.0 for _, line in log)
    assert all(line[gradient_share("extra")] == 0.0 for _, line in log)


def test_shares_of_two_phases_carry_their_optimizers(tmp_path: Path) -> None:
    def make_one(more: dict[str, Any]) -> tuple[Any, Any]:
        trainer = make_two(tmp_path / f"{more}", **more)
        return trainer, trainer.log

    for _, line in assert_no_effect(make_one, lambda: batches(0)):
        assert line[gradient_share("fit", "main")] == 1.0
        assert line["gradient_share/judge/judge"] == 1.0


class InTurn:
    """One of two phases a step, each with two terms whose gradients are known."""

    def __init__(self, model: nn.Module) -> None:
        self.model, self.calls = model, 0

    def phases(self, batch: Any, generator_of: GeneratorOf) -> Iterator[Phase]:
        self.calls += 1
        weight = next(self.model.parameters())
        steep, flat = 3 * weight[0, 0], 4 * weight[0, 1]
        yield Phase(("main",) if self.calls % 2 else ("judge",), {"steep": steep, "flat": flat})


@pytest.mark.parametrize("log_every", [2, 3, 6])
def test_a_line_has_the_shares_of_both_phases_that_alternate(
    tmp_path: Path, log_every: int
) -> None:
    trainer = make_two(tmp_path, log_every=log_every, clip_norm=None, **ON)
    trainer.scheme = InTurn(trainer.model)
    trainer.optimizers["judge"] = trainer.optimizers["main"]
    trainer.fit(batches(0), State(seed=0))
    assert len(trainer.log) == 6 // log_every
    for _, line in trainer.log:
        for optimizer in ("main", "judge"):
            assert line[gradient_share("steep", optimizer)] == pytest.approx(9 / 25)
            assert line[gradient_ratio("flat", optimizer)] == pytest.approx(4 / 5)


def test_shares_are_measured_in_the_last_two_steps_before_a_line(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, max_steps=7, log_every=3, **ON)
    assert [trainer._measures_shares(step) for step in range(7)] == [
        *(False, True, True, False, True, True, True)
    ]
    silent, _ = make(tmp_path, max_steps=7, log_every=3)
    assert not any(map(silent._measures_shares, range(7)))


class Kept:
    """A phase that adds to the gradients of the phase before."""

    def __init__(self, model: nn.Module) -> None:
        self.model = model

    def phases(self, batch: Any, generator_of: GeneratorOf) -> Iterator[Phase]:
        weight = next(self.model.parameters())
        yield Phase(("main",), {"first": 100 * weight[0, 0]})
        yield Phase(("judge",), {"steep": 3 * weight[0, 0], "flat": 4 * weight[0, 1]}, clear=False)


def test_gradients_of_the_phase_before_are_not_counted(tmp_path: Path) -> None:
    trainer = make_two(tmp_path, clip_norm=None, max_steps=1, eval_every=1, **ON)
    trainer.scheme = Kept(trainer.model)
    trainer.optimizers["judge"] = trainer.optimizers["main"]
    trainer.fit(batches(0), State(seed=0))
    ((_, line),) = trainer.log
    assert line["grad_norm/judge"] == pytest.approx(math.hypot(103, 4))
    assert line[gradient_share("steep", "judge")] == pytest.approx(9 / 25)


def two_terms() -> dict[str, float]:
    """Shares over the processes: the gradient of `own` differs between them."""
    from torch import distributed

    rank = distributed.get_rank() if distributed.is_initialized() else None
    weight = nn.Parameter(torch.ones(2))
    terms = TermGradients([weight], Tensor.backward)
    # The mean over two processes is (3, 0), which one process has by itself.
    slope = 3.0 if rank is None else (1.0, 5.0)[rank]
    terms.add({"own": slope * weight[0], "same": 4 * weight[1]}, 1.0)
    return terms.shares("")


@pytest.mark.slow
def test_shares_of_several_processes_are_those_of_all() -> None:
    expected = two_terms()
    assert expected[gradient_share("own")] == pytest.approx(9 / 25)
    for found in run_in_processes(two_terms, 2):
        assert found == pytest.approx(expected)


CASES = {
    "one optimizer, both domains": (False, {**PAPERS, "supervise_target": True}),
    "two heads, apart": (True, {**PAPERS, "gradients": "apart", "supervise_target": True}),
    "two heads, kept": (True, {**PAPERS, "gradients": "kept", "supervise_target": True}),
    "two heads, together": (True, {**PAPERS, "gradients": "together"}),
    "HeatNet, in turn": (False, HEATNET),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("accumulate", [1, 2])
def test_adaptation_trains_alike_and_shares_add_to_1(
    tmp_path: Path, case: str, accumulate: int
) -> None:
    heads, changes = CASES[case]

    def make_one(more: dict[str, Any]) -> tuple[Any, Any]:
        model = network(heads)
        scheme = scheme_of(model, heads, **changes)
        settings = {"accumulate": accumulate, **more}
        made = trainer(scheme, model, tmp_path / f"{more}", 4, **settings)
        log: list[tuple[int, dict[str, float]]] = []
        made.record = lambda step, values: log.append((step, values))
        return made, log

    def data() -> Iterator[Any]:
        return (pair for pair in pairs(confidence=True) for _ in range(accumulate))

    for _, line in assert_no_effect(make_one, data):
        phases = {key.partition("/")[2] for key in line if key.startswith("grad_norm/")}
        assert phases
        for optimizers in phases:
            prefix = f"gradient_share/{optimizers}/"
            shares = [value for key, value in line.items() if key.startswith(prefix)]
            assert sum(shares) == pytest.approx(1.0, abs=1e-5)


def test_compiled_networks_are_refused() -> None:
    with pytest.raises(InputError, match=r"requires trainer\.compile=none, got default"):
        TrainerSettings(**SETTINGS, compile="default", **ON)


EXPERIMENTS = {
    "crm": ("+experiment=crm",),
    "crm, recomputed": ("+experiment=crm", "trainer.activation_checkpointing=true"),
    "mixed": ("+experiment=mfnet", "trainer.precision=bf16-mixed", "masker.patch_size=null"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_runs_log_shares_that_add_to_1_and_train_alike(
    call: Call, data: Path, tmp_path: Path, name: str
) -> None:
    lines: list[list[dict[str, Any]]] = []
    for folder, more in (("off", ()), ("on", ("trainer.log_gradient_shares=true",))):
        steps = ("trainer.max_steps=2", "trainer.eval_every=2")
        code, _, said = train(call, data, tmp_path / folder, *EXPERIMENTS[name], *steps, *more)
        assert code == 0, said
        lines.append(logged(only_run(tmp_path / folder), "train"))
    assert "mean share of the gradient by loss term: " in said
    for off, on in zip(*lines, strict=True):
        values, others = off["values"], on["values"]
        losses = {k: v for k, v in values.items() if k.startswith(("loss", "grad_norm"))}
        assert losses == {k: others[k] for k in losses}
        terms = {k.removeprefix("loss/") for k in losses if k.startswith("loss/")}
        shares = {term: others[gradient_share(term)] for term in terms}
        assert sum(shares.values()) == pytest.approx(1.0, abs=1e-5)
        if name.startswith("crm"):
            assert {"sdc", "sdn"} < terms
    folders = [only_run(tmp_path / each).name for each in ("off", "on")]
    assert folders[0] == folders[1]  # the same key
    first, second = (
        torch.load(tmp_path / each / folders[0] / "best.pt", weights_only=True)["model"]
        for each in ("off", "on")
    )
    assert all(torch.equal(value, second[key]) for key, value in first.items())


def terms_of(parts: dict[str, Tensor], model: nn.Module) -> dict[str, float]:
    """Norms by backward passes of their own, as anybody would measure them."""
    norms = {}
    for name, part in parts.items():
        model.zero_grad()
        part.backward(retain_graph=True)
        squares = [p.grad.square().sum() for p in model.parameters() if p.grad is not None]
        norms[name] = float(torch.stack(squares).sum().sqrt())
    model.zero_grad()
    sum(parts.values()).backward()
    squares = [p.grad.square().sum() for p in model.parameters() if p.grad is not None]
    return {**norms, "": float(torch.stack(squares).sum().sqrt())}


def test_ratios_are_those_of_separate_backward_passes() -> None:
    torch.manual_seed(0)
    model = nn.Sequential(nn.Linear(5, 8), nn.GELU(), nn.Linear(8, 3))
    out = model(torch.randn(7, 5))
    parts = {"a": out.square().mean(), "b": out[:, 0].abs().mean(), "c": -out[:, 1].sum()}
    terms = TermGradients(list(model.parameters()), Tensor.backward)
    terms.add(parts, 1.0)
    found, expected = terms.shares(""), terms_of(parts, model)
    for name in parts:
        assert found[gradient_ratio(name)] == pytest.approx(expected[name] / expected[""], rel=1e-5)


def test_sentence_has_the_mean_of_each_term() -> None:
    lines = [
        {"loss": 1.0, "gradient_share/a": 0.75, "gradient_share/b": 0.25, "gradient_ratio/a": 9.0},
        {"loss": 1.0},
        {"gradient_share/a": 0.25, "gradient_share/b": 0.75},
    ]
    expected = "mean share of the gradient by loss term: a 50.0 %, b 50.0 %"
    assert shares_sentence(lines) == expected
    assert shares_sentence([{"loss": 1.0}]) == ""
    assert shares_sentence([{"gradient_share/a": -1e-5}]).endswith(": a 0.0 %")
