"""The loop: it learns, resumes to the same bits, accumulates, and stops on non-finite values."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checks import RunError
from rgbt.engine.checkpoint import State, load_checkpoint
from rgbt.engine.optimizers import SGD, Adam, AdamW
from rgbt.engine.schedules import Poly, ThesisPoly
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Hooks, Trainer
from rgbt.randomness import torch_generator
from rgbt.requirements import NetworkRecord
from rgbt.types import Batch, GeneratorOf, Phase
from tests.checkpoints.test_torch_files import same

SETTINGS = {
    "max_steps": 6,
    "eval_every": 3,
    "checkpoint_minutes": 0,
    "log_every": 1,
    "accumulate": 1,
    "clip_norm": 1.0,
    "precision": "32-true",
    "accelerator": "cpu",
    "threads": 1,
    "selection_split": "val",
}
ADAMW: dict[str, Any] = {
    "lr": 0.1,
    "backbone_multiplier": 1.0,
    "weight_decay": 0.05,
    "decay_biases": True,
    "betas": (0.9, 0.999),
    "eps": 1e-8,
}


class Noisy:
    """Fits the mean of the image under noise drawn from the step's generator."""

    def __init__(self, model: nn.Module, poison: int | None = None) -> None:
        self.model, self.poison, self.calls = model, poison, 0

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        noise = torch.randn(batch.rgb.shape, generator=generator_of("noise"))
        guess = self.model((batch.rgb + 0.1 * noise).mean((2, 3)))
        loss = (guess - batch.rgb.mean((1, 2, 3))[:, None]).square().mean()
        if self.calls == self.poison:
            loss = loss * float("nan")
        self.calls += 1
        logged = {"noise/mean": noise.mean()}
        yield Phase(("main",), {"fit": loss, "extra": 0 * loss}, logged=logged)


class Recorded(Hooks):
    """Keeps what is logged; the score of an evaluation is its step."""

    def __init__(self) -> None:
        self.lines: list[tuple[int, dict[str, float]]] = []

    def log(self, step: int, values: dict[str, float]) -> None:
        self.lines.append((step, values))

    def evaluate(self, step: int, network: nn.Module) -> float | None:
        return float(step)


def batches(start: int, batch_size: int = 4) -> Iterator[Batch]:
    step = start
    while True:
        rgb = torch.rand(batch_size, 3, 8, 8, generator=torch_generator(0, "data", step))
        yield Batch(
            rgb=(rgb * 255).to(torch.uint8),
            thermal=(rgb[:, :1] * 255).to(torch.uint8),
            label=torch.zeros(batch_size, 8, 8, dtype=torch.int64),
            name=tuple("abcdefgh"[:batch_size]),
            centre_yx=torch.zeros(batch_size, 2, dtype=torch.int64),
            position=None,
            original_hw=torch.full((batch_size, 2), 8),
        )
        step += 1


def halves() -> Iterator[Batch]:
    for batch in batches(0):
        for part in (slice(0, 2), slice(2, 4)):
            tensors = {key: value[part] for key, value in vars(batch).items() if value is not None}
            yield replace(batch, **tensors)


def stopping_after(steps: int) -> Iterator[Batch]:
    yield from islice(batches(0), steps)
    raise KeyboardInterrupt


def make(folder: Path, poison: int | None = None, **changes: object) -> tuple[Trainer, list]:
    fabric = Fabric(accelerator="cpu", devices=1)
    torch.manual_seed(1)
    model = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 1))
    wrapped, optimizer = fabric.setup(model, AdamW(**ADAMW)(model))
    hooks = Recorded()
    trainer = Trainer(
        fabric=fabric,
        settings=TrainerSettings(**{**SETTINGS, **changes}),
        phases=Noisy(wrapped, poison).phases,
        model=wrapped,
        others={},
        optimizers={"main": optimizer},
        schedule=Poly(power=0.9, per="iteration", warmup_steps=0),
        steps_per_epoch=2,
        folder=folder,
        hooks=hooks,
    )
    return trainer, hooks.lines


def sgd(model: nn.Module, **changes: Any) -> torch.optim.Optimizer:
    given = {"lr": 0.25, "backbone_multiplier": 1.0, "momentum": 0.0, "weight_decay": 0.0}
    return SGD(**{**given, **changes})(model)


def test_losses_and_values_beside_them_are_logged(tmp_path: Path) -> None:
    trainer, log = make(tmp_path, max_steps=60, eval_every=60)
    trainer.fit(batches(0), State(seed=0))
    (_, first), (_, last) = log[0], log[-1]
    assert last["loss"] < 0.1 * first["loss"]
    assert {"loss/fit", "loss/extra", "grad_norm", "lr/main_0", "images_per_s"} <= set(first)
    noise = torch.randn(4, 3, 8, 8, generator=torch_generator(0, "noise", 0))
    assert first["noise/mean"] == pytest.approx(noise.mean().item())
    assert first["loss"] == first["loss/fit"]


def test_every_step_is_timed_with_its_wait_for_images(tmp_path: Path) -> None:
    trainer, log = make(tmp_path)
    timed: list[tuple[float, float]] = []
    trainer.note_pace = lambda *step: timed.append(step)  # type: ignore[assignment]
    trainer.fit(batches(0), State(seed=0))
    for (seconds, waited), (_, values) in zip(timed, log, strict=True):
        assert seconds == pytest.approx(4 / values["images_per_s"])
        assert waited / seconds == pytest.approx(values["wait_share"])


def test_value_not_finite_is_named_and_stops_the_run(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, poison=3)
    with pytest.raises(RunError, match=r"step 4: fit is nan"):
        trainer.fit(batches(0), State(seed=0))
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())


@pytest.mark.parametrize(("poisoned", "value"), [(2, "nan"), (3, "inf")])
def test_weights_not_finite_are_neither_saved_nor_evaluated(
    tmp_path: Path, poisoned: int, value: str
) -> None:
    trainer, _ = make(tmp_path)
    evaluated: list[int] = []
    trainer.hooks.evaluate = lambda step, _: float(evaluated.append(step) or step)

    def poison(step: int, values: dict[str, float]) -> None:
        if step == poisoned:
            trainer.model.get_submodule("2").bias.data[0] = float(value)

    trainer.hooks.log = poison
    with pytest.raises(RunError, match=rf"step {poisoned}: '2.bias' holds NaN or infinity"):
        trainer.fit(batches(0), State(seed=7))
    assert evaluated == []
    # Every step writes a checkpoint, step 3 would evaluate.
    assert (tmp_path / "last.pt").exists()
    assert load_checkpoint(tmp_path / "last.pt")["state"]["step"] == poisoned - 1


class Alternating:
    """A network that fits, and a judge that fits too, in turn; both under noise of the step."""

    def __init__(self, model: nn.Module, judge: nn.Module) -> None:
        self.model, self.others = model, {"judge": judge}
        self.calls, self.dies_at = 0, -1

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        noise = torch.randn(batch.rgb.shape, generator=generator_of("noise"))
        seen = (batch.rgb + 0.1 * noise).mean((2, 3))
        wanted = batch.rgb.mean((1, 2, 3))[:, None]
        yield Phase(("main",), {"fit": (self.model(seen) - wanted).square().mean()})
        self.calls += 1
        if self.calls == self.dies_at:
            raise KeyboardInterrupt
        yield Phase(("judge",), {"judge": (self.others["judge"](seen) - wanted).abs().mean()})


def make_two(folder: Path, **changes: object) -> Trainer:
    trainer, log = make(folder, **changes)
    torch.manual_seed(2)
    judge = nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4), nn.Linear(4, 1))
    trainer.scheme = Alternating(trainer.model, judge)
    trainer.phases, trainer.others = trainer.scheme.phases, trainer.scheme.others
    builder = Adam(lr=0.05, betas=(0.9, 0.99), weight_decay=0.0, eps=1e-8)
    trainer.optimizers["judge"] = builder(judge)
    trainer.log = log
    return trainer


def test_resume_equals_straight_through(tmp_path: Path) -> None:
    """Of both networks, with statistics and moments; killed between the phases of a step."""
    straight = make_two(tmp_path / "a")
    straight.fit(batches(0), State(seed=7))
    first = make_two(tmp_path / "b")
    first.scheme.dies_at = 6
    with pytest.raises(KeyboardInterrupt):
        first.fit(batches(0), State(seed=7))
    second, state = make_two(tmp_path / "b"), State(seed=7)
    assert second.resume(state)
    assert state.step == 5
    second.fit(batches(state.step), state)
    assert (state.best_step, state.best_score) == (6, 6.0)
    ends = [load_checkpoint(tmp_path / where / "last.pt") for where in ("a", "b")]
    assert all(same(ends[0][part], ends[1][part]) for part in ("model", "others", "optimizers"))
    assert "1.running_mean" in ends[0]["others"]["judge"]
    assert [v["loss"] for _, v in straight.log[5:]] == [v["loss"] for _, v in second.log]
    logged = straight.log[0][1]
    assert {"grad_norm/main", "grad_norm/judge"} <= set(logged)
    assert logged["loss"] == pytest.approx(logged["loss/fit"] + logged["loss/judge"])


@pytest.mark.parametrize(
    ("tested", "scores", "kept"),
    [
        ("best", {3: 0.9, 6: 0.1}, 3),
        ("best", {3: math.nan, 6: math.nan}, 6),
        ("last", {3: 0.9, 6: 0.1}, 6),
        ("last", None, 6),
    ],
)
def test_which_checkpoint_is_tested(
    tmp_path: Path, tested: str, scores: dict[int, float] | None, kept: int
) -> None:
    """Without a selection split or a score, the last weights are the best."""
    trainer, _ = make(tmp_path, tested=tested)
    trainer.hooks.evaluate = lambda step, _: None if scores is None else scores[step]
    written: list[bool] = []
    trainer.hooks.log = lambda *_: written.append((tmp_path / "best.pt").exists())
    state = State(seed=0)
    trainer.fit(batches(0), state)
    best = load_checkpoint(tmp_path / "best.pt")
    is_scored = scores is not None and not math.isnan(scores[kept])
    expected = (kept, kept, scores[kept] if is_scored else -1.0, 6)
    assert (best["step"], state.best_step, state.best_score, state.evaluated_step) == expected
    assert written == [False] * 3 + [scores is not None] * 3
    last = load_checkpoint(tmp_path / "last.pt")
    assert same(dict(last["model"]), dict(best["model"])) == (kept == 6)


@pytest.mark.parametrize("clear", [True, False])
@pytest.mark.parametrize("clip_norm", [None, 1e-3])
def test_accumulated_phases_equal_those_of_the_whole_batch(
    tmp_path: Path, clear: bool, clip_norm: float | None
) -> None:
    """Two optimisers that share everything, in two phases."""
    found = []
    for accumulate, given in ((1, batches(0)), (2, halves())):
        changes = {"max_steps": 2, "accumulate": accumulate, "clip_norm": clip_norm}
        trainer, log = make(tmp_path / str(accumulate), **changes)
        model = trainer.model

        def phases(batch: Batch, _: GeneratorOf, model: nn.Module = model) -> Iterator[Phase]:
            seen = batch.rgb.mean((2, 3))
            yield Phase(("main",), {"one": model(seen).square().mean()})
            yield Phase(("second",), {"two": (model(seen) - 1).square().mean()}, clear=clear)

        trainer.phases = phases
        trainer.optimizers = {
            name: sgd(model, lr=0.05, momentum=0.9, weight_decay=0.01)
            for name in ("main", "second")
        }
        trainer.fit(given, State(seed=0))
        logged = torch.tensor([log[0][1][name] for name in ("loss", "loss/one", "loss/two")])
        found.append([logged, *(p.detach().clone() for p in model.parameters())])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b)


@pytest.mark.parametrize("clear", [True, False])
def test_what_is_not_cleared_is_added(tmp_path: Path, clear: bool) -> None:
    """SGD by hand on one weight: w - lr g1, then - lr g2 or - lr (g1 + g2)."""
    trainer, _ = make(tmp_path, max_steps=1, clip_norm=None)
    model = trainer.model = nn.Linear(1, 1, bias=False)
    nn.init.constant_(model.weight, 2.0)
    trainer.optimizers = {"main": sgd(model), "second": sgd(model)}
    trainer.schedule = lambda step, total, per_epoch: 1.0
    ones = next(batches(0))
    ones.rgb.fill_(255)

    def phases(batch: Batch, _: GeneratorOf) -> Iterator[Phase]:
        seen = batch.rgb[:, :1].mean((2, 3))
        yield Phase(("main",), {"one": model(seen).square().mean()})  # w^2: 2 w = 4
        yield Phase(("second",), {"two": 3 * model(seen).mean()}, clear=clear)  # 3 w: 3

    trainer.phases = phases
    trainer.fit(iter([ones]), State(seed=0))
    assert model.weight.item() == pytest.approx(2 - 0.25 * 4 - 0.25 * (3 if clear else 7))


def test_line_has_the_last_values_of_alternating_steps(tmp_path: Path) -> None:
    trainer, log = make(tmp_path, max_steps=4, log_every=2)
    calls = iter(("even", "odd") * 2)

    def phases(batch: Batch, _: GeneratorOf) -> Iterator[Phase]:
        loss = trainer.model(batch.rgb.mean((2, 3))).square().mean()
        yield Phase(("main",), {next(calls): loss})

    trainer.phases = phases
    trainer.fit(batches(0), State(seed=0))
    assert [step for step, _ in log] == [2, 4]
    assert all({"loss/even", "loss/odd"} <= set(values) for _, values in log)


def test_every_accumulated_batch_has_draws_of_its_own(tmp_path: Path) -> None:
    """Those of its number in the run: of its own, whatever step they are accumulated to."""
    trainer, _ = make(tmp_path, max_steps=2, accumulate=3)
    seen: list[Tensor] = []

    def phases(batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        seen.append(torch.rand(4, generator=generator_of("noise")))
        yield Phase(("main",), {"fit": trainer.model(batch.rgb.mean((2, 3))).mean()})

    trainer.phases = phases
    trainer.fit(batches(0), State(seed=7))
    expected = [torch.rand(4, generator=torch_generator(7, "noise", n)) for n in range(6)]
    assert all(torch.equal(a, b) for a, b in zip(seen, expected, strict=True))


AT_ONCE = (("a", "b"), (3, 4, 4))
IN_TURN = ((("a",), (3, 4, 4)), (("b",), (12, 0, 5)))
ROOT = 41**0.5


@pytest.mark.parametrize(
    ("phases", "limit", "ends", "norms"),
    [
        # The norm of 3, 4 and 4 is the root of 41; the shared parameter is stepped twice with it.
        ((AT_ONCE,), 1.0, (-6 / ROOT, -4 / ROOT, -4 / ROOT), {"/a+b": ROOT}),
        ((AT_ONCE,), None, (-6, -4, -4), {"/a+b": ROOT}),
        # 3 and 4 of 5; then 12 and 5 of 13, what "a" left of the other head being cleared.
        (IN_TURN, 1.0, (-3 / 5 - 12 / 13, -4 / 5, -5 / 13), {"/a": 5, "/b": 13}),
        # The only optimiser clips all it has.
        (((("all",), (3, 4, 4)),), 1.0, (-3 / ROOT, -4 / ROOT, -4 / ROOT), {"": ROOT}),
    ],
)
def test_gradients_are_clipped_once_per_phase(
    tmp_path: Path, phases: Any, limit: float | None, ends: tuple[float, ...], norms: dict[str, Any]
) -> None:
    """Parameters at 0, the first of which two optimisers may share."""
    trainer, log = make(tmp_path, max_steps=1, clip_norm=limit)
    trainer.model = nn.ParameterList([nn.Parameter(torch.zeros(1)) for _ in range(3)])
    shared, one, other = trainer.model
    parts = {"a": [shared, one], "b": [shared, other]}
    if phases[0][0] == ("all",):
        parts = {"all": [shared, one, other]}
    groups = {name: [{"params": part, "base_lr": 1.0}] for name, part in parts.items()}
    trainer.optimizers = {name: torch.optim.SGD(part, lr=1.0) for name, part in groups.items()}

    def scheme(batch: Batch, _: GeneratorOf) -> Iterator[Phase]:
        for names, gradients in phases:
            pairs = zip(gradients, (shared, one, other), strict=True)
            yield Phase(names, {"fit": sum(factor * value for factor, value in pairs).sum()})

    trainer.phases = scheme
    trainer.fit(batches(0), State(seed=0))
    assert [value.item() for value in trainer.model] == pytest.approx(list(ends), rel=1e-5)
    found = {name: value for name, value in log[0][1].items() if name.startswith("grad_norm")}
    assert found == {f"grad_norm{name}": pytest.approx(norm) for name, norm in norms.items()}


@pytest.mark.parametrize("head_rate", ["scheduled", "released"])
def test_rates_of_parts_follow_schedule_in_two_sessions(tmp_path: Path, head_rate: Any) -> None:
    """Rates lr (1 - t / T)^0.9, t from 1; or constant, of the head of "SH-Maximum squares loss"."""
    model = nn.ModuleDict({"backbone": nn.Linear(3, 2), "head": nn.Linear(2, 1)})
    model.record = NetworkRecord(pretrained_parts=("backbone.",))
    logged: list[Any] = []

    def phases(batch: Batch, _: GeneratorOf) -> Iterator[Phase]:
        seen = model.head(model.backbone(batch.rgb.mean((2, 3))))
        yield Phase(("main",), {"fit": seen.square().mean()})

    for stop in (3, 5):
        trainer, log = make(tmp_path, max_steps=stop, checkpoint_minutes=0)
        optimizer = sgd(model, lr=0.1, backbone_multiplier=0.5, head_rate=head_rate)
        trainer = replace(trainer, model=model, optimizers={"main": optimizer})
        trainer.phases = phases
        trainer.schedule = lambda step, *_: ThesisPoly(power=0.9)(step, 5, 1)
        state = State(seed=0)
        trainer.resume(state)
        trainer.fit(batches(state.step), state)
        logged += [(values["lr/main_0"], values["lr/main_1"]) for _, values in log]
    factors = [(1 - step / 5) ** 0.9 for step in range(1, 6)]
    of_head = [1] * 5 if head_rate == "released" else factors
    assert logged == [pytest.approx((0.05 * a, 0.1 * b)) for a, b in zip(factors, of_head)]
