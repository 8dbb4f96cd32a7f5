"""The loop: it learns, resumes to the same bits, accumulates, and stops on non-finite values."""

from __future__ import annotations

from collections.abc import Iterator
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
from rgbt.engine.schedules import Poly
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Trainer
from rgbt.randomness import torch_generator
from rgbt.types import Batch, GeneratorOf, Phase
from tests.checkpoints.test_torch_files import same

SETTINGS = {
    "max_steps": 6,
    "eval_every": 3,
    "checkpoint_every": 2,
    "log_every": 1,
    "accumulate": 1,
    "clip_norm": 1.0,
    "precision": "32-true",
    "accelerator": "cpu",
    "threads": 1,
    "selection_split": "val",
}


class Noisy:
    """Fits the mean of the image under noise drawn from the step's generator."""

    def __init__(self, model: nn.Module, poison: int | None = None) -> None:
        self.model = model
        self.poison = poison
        self.calls = 0

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        noise = torch.randn(batch.rgb.shape, generator=generator_of("noise"))
        guess = self.model((batch.rgb + 0.1 * noise).mean((2, 3)))
        loss = (guess - batch.rgb.mean((1, 2, 3))[:, None]).square().mean()
        if self.calls == self.poison:
            loss = loss * float("nan")
        self.calls += 1
        logged = {"noise/mean": noise.mean()}
        yield Phase(("main",), {"fit": loss, "extra": 0 * loss}, logged=logged)


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


def stopping_after(steps: int) -> Iterator[Batch]:
    yield from islice(batches(0), steps)
    raise KeyboardInterrupt


def make(folder: Path, poison: int | None = None, **changes: object) -> tuple[Trainer, list]:
    fabric = Fabric(accelerator="cpu", devices=1)
    torch.manual_seed(1)
    model = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 1))
    builder = AdamW(
        lr=0.1,
        backbone_multiplier=1.0,
        weight_decay=0.05,
        decay_biases=True,
        betas=(0.9, 0.999),
        eps=1e-8,
    )
    wrapped, optimizer = fabric.setup(model, builder(model))
    log: list = []
    trainer = Trainer(
        fabric=fabric,
        settings=TrainerSettings(**{**SETTINGS, **changes}),
        scheme=Noisy(wrapped, poison),
        model=wrapped,
        others={},
        optimizers={"main": optimizer},
        schedule=Poly(power=0.9, per="iteration", warmup_steps=0),
        steps_per_epoch=2,
        folder=folder,
        record=lambda step, values: log.append((step, values)),
        validate=lambda step: float(step),
    )
    return trainer, log


def test_resume_equals_straight_through(tmp_path: Path) -> None:
    straight, log = make(tmp_path / "a")
    straight.fit(batches(0), State(seed=7))

    first, _ = make(tmp_path / "b", max_steps=6)
    with pytest.raises(KeyboardInterrupt):
        first.fit(stopping_after(5), State(seed=7))

    second, second_log = make(tmp_path / "b")
    resumed = State(seed=7)
    assert second.resume(resumed)
    assert resumed.step == 4  # the last checkpoint, written every second step
    second.fit(batches(resumed.step), resumed)

    for a, b in zip(straight.model.parameters(), second.model.parameters(), strict=True):
        assert torch.equal(a, b)
    assert [values["loss"] for _, values in log[4:]] == [v["loss"] for _, v in second_log]
    assert resumed.best_step == 6
    assert resumed.best_score == 6.0


def test_loss_falls(tmp_path: Path) -> None:
    trainer, log = make(tmp_path, max_steps=60, eval_every=60)
    trainer.fit(batches(0), State(seed=0))
    assert log[-1][1]["loss"] < 0.1 * log[0][1]["loss"]
    assert {"loss/fit", "loss/extra", "grad_norm", "lr/main_0", "images_per_s"} <= set(log[0][1])
    # Values beside the loss: logged under their own name, and no part of it.
    noise = torch.randn(4, 3, 8, 8, generator=torch_generator(0, "noise", 0))
    assert log[0][1]["noise/mean"] == pytest.approx(noise.mean().item())
    assert log[0][1]["loss"] == log[0][1]["loss/fit"]
    assert "loss/noise/mean" not in log[0][1]


def halves() -> Iterator[Batch]:
    for batch in batches(0):
        for part in (slice(0, 2), slice(2, 4)):
            yield Batch(
                batch.rgb[part],
                batch.thermal[part],
                batch.label[part],
                batch.name[part],
                batch.centre_yx[part],
                None,
                batch.original_hw[part],
            )


def test_a_value_that_is_not_finite_stops_the_run_and_is_named(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, poison=3)
    before = [p.clone() for p in trainer.model.parameters()]
    with pytest.raises(RunError, match=r"step 4: fit is nan"):
        trainer.fit(batches(0), State(seed=0))
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, trainer.model.parameters()))


@pytest.mark.parametrize(("poisoned", "value"), [(2, "nan"), (3, "inf")])
def test_weights_that_are_not_finite_are_neither_saved_nor_evaluated(
    tmp_path: Path, poisoned: int, value: str
) -> None:
    trainer, _ = make(tmp_path)
    evaluated: list[int] = []
    trainer.validate = lambda step: float(evaluated.append(step) or step)

    def poison(step: int, values: dict[str, float]) -> None:
        if step == poisoned:
            trainer.model.get_submodule("2").bias.data[0] = float(value)

    trainer.record = poison
    said = rf"step {poisoned}: '2.bias' holds NaN or infinity"
    with pytest.raises(RunError, match=said):
        trainer.fit(batches(0), State(seed=7))
    assert evaluated == []
    # Step 2 writes a checkpoint, step 3 would evaluate.
    assert trainer.checkpoints.last.exists() == (poisoned == 3)


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
    trainer.others = trainer.scheme.others
    builder = Adam(lr=0.05, betas=(0.9, 0.99), weight_decay=0.0, eps=1e-8)
    trainer.optimizers["judge"] = builder(judge)
    trainer.log = log
    return trainer


def test_others_are_resumed_with_their_statistics_and_moments(tmp_path: Path) -> None:
    straight = make_two(tmp_path / "a")
    straight.fit(batches(0), State(seed=7))
    first = make_two(tmp_path / "b")
    first.scheme.dies_at = 6  # between the phases of its last step
    with pytest.raises(KeyboardInterrupt):
        first.fit(batches(0), State(seed=7))
    second, state = make_two(tmp_path / "b"), State(seed=7)
    assert second.resume(state)
    assert state.step == 4
    second.fit(batches(4), state)
    ends = [load_checkpoint(tmp_path / where / "last.pt") for where in ("a", "b")]
    for part in ("model", "others", "optimizers"):
        assert same(ends[0][part], ends[1][part])
    assert set(ends[0]["others"]) == {"judge"}
    assert "1.running_mean" in ends[0]["others"]["judge"]
    assert [v["loss"] for _, v in straight.log[4:]] == [v["loss"] for _, v in second.log]
    assert {"loss/fit", "loss/judge", "grad_norm/main", "grad_norm/judge"} <= set(
        straight.log[0][1]
    )
    assert straight.log[0][1]["loss"] == pytest.approx(
        straight.log[0][1]["loss/fit"] + straight.log[0][1]["loss/judge"]
    )


@pytest.mark.parametrize(("tested", "kept"), [("best", 3), ("last", 6)])
def test_which_checkpoint_is_tested(tmp_path: Path, tested: str, kept: int) -> None:
    trainer, _ = make(tmp_path, tested=tested)
    trainer.validate = {3: 0.9, 6: 0.1}.__getitem__
    state = State(seed=0)
    trainer.fit(batches(0), state)
    assert load_checkpoint(tmp_path / "best.pt")["step"] == kept
    assert (state.best_step, state.best_score) == (kept, {3: 0.9, 6: 0.1}[kept])
    last = load_checkpoint(tmp_path / "last.pt")
    same = all(
        torch.equal(value, last["model"][name])
        for name, value in load_checkpoint(tmp_path / "best.pt")["model"].items()
    )
    assert same == (tested == "last")


def test_without_validation_the_best_weights_are_the_last(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, tested="last")
    trainer.validate = None
    commit, best_steps = trainer.checkpoints.commit, []

    def noting(payload: dict[str, Any], state: State) -> None:
        best_steps.append(state.best_step)
        commit(payload, state)

    trainer.checkpoints.commit = noting
    state = State(seed=0)
    trainer.fit(batches(0), state)
    assert best_steps[-1] == 6
    assert set(best_steps[:-1]) == {0}, "not at step 3, which is due for an evaluation"
    assert (state.evaluated_step, state.best_score) == (6, -1.0)
    last, best = (load_checkpoint(tmp_path / name)["model"] for name in ("last.pt", "best.pt"))
    assert all(torch.equal(value, last[name]) for name, value in best.items())


class Shared:
    """Two optimisers that share everything, in two phases; the mean of images, no noise."""

    def __init__(self, model: nn.Module, clear: bool) -> None:
        self.model, self.clear = model, clear

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        del generator_of
        seen = batch.rgb.mean((2, 3))
        yield Phase(("main",), {"one": self.model(seen).square().mean()})
        yield Phase(("second",), {"two": (self.model(seen) - 1).square().mean()}, clear=self.clear)


@pytest.mark.parametrize("clear", [True, False])
@pytest.mark.parametrize("clip_norm", [None, 1e-3])
def test_accumulated_phases_equal_those_of_the_whole_batch(
    tmp_path: Path, clear: bool, clip_norm: float | None
) -> None:
    found = []
    for where, accumulate in (("whole", 1), ("halves", 2)):
        trainer, log = make(
            tmp_path / where, max_steps=2, accumulate=accumulate, clip_norm=clip_norm
        )
        trainer.scheme = Shared(trainer.model, clear)
        builder = SGD(lr=0.05, backbone_multiplier=1.0, momentum=0.9, weight_decay=0.01)
        trainer.optimizers = {"main": builder(trainer.model), "second": builder(trainer.model)}
        trainer.fit(batches(0) if accumulate == 1 else halves(), State(seed=0))
        logged = torch.tensor([log[0][1][name] for name in ("loss", "loss/one", "loss/two")])
        found.append([logged, *(p.detach().clone() for p in trainer.model.parameters())])
    for a, b in zip(*found, strict=True):
        torch.testing.assert_close(a, b)


def test_what_is_not_cleared_is_added(tmp_path: Path) -> None:
    """SGD by hand on one weight: w - lr g1, then - lr g2 or - lr (g1 + g2)."""
    for clear in (True, False):
        trainer, _ = make(tmp_path / str(clear), max_steps=1, clip_norm=None)
        model = nn.Linear(1, 1, bias=False)
        nn.init.constant_(model.weight, 2.0)
        builder = SGD(lr=0.25, backbone_multiplier=1.0, momentum=0.0, weight_decay=0.0)
        trainer.model = model
        trainer.optimizers = {"main": builder(model), "second": builder(model)}
        trainer.schedule = lambda step, total, per_epoch: 1.0
        ones = next(batches(0))
        ones.rgb.fill_(255)

        def phases(batch: Batch, generator_of: GeneratorOf, *, clear: bool = clear, model=model):
            seen = batch.rgb[:, :1].mean((2, 3))
            yield Phase(("main",), {"one": model(seen).square().mean()})  # w^2: 2 w = 4
            yield Phase(("second",), {"two": 3 * model(seen).mean()}, clear=clear)  # 3 w: 3

        trainer.scheme.phases = phases
        trainer.fit(iter([ones]), State(seed=0))
        expected = 2 - 0.25 * 4 - 0.25 * (3 if clear else 7)
        assert model.weight.item() == pytest.approx(expected)


def test_a_line_has_the_last_values_of_steps_that_alternate(tmp_path: Path) -> None:
    trainer, log = make(tmp_path, max_steps=4, log_every=2)
    model, calls = trainer.model, iter(range(100))

    def phases(batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        name = ("even", "odd")[next(calls) % 2]
        yield Phase(("main",), {name: model(batch.rgb.mean((2, 3))).square().mean()})

    trainer.scheme.phases = phases
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

    trainer.scheme.phases = phases
    trainer.fit(batches(0), State(seed=7))
    expected = [torch.rand(4, generator=torch_generator(7, "noise", n)) for n in range(6)]
    assert len(seen) == 6
    assert all(torch.equal(a, b) for a, b in zip(seen, expected, strict=True))


class Heads(nn.Module):
    """Parameters at 0, the first of which two optimisers may share."""

    def __init__(self) -> None:
        super().__init__()
        self.shared, self.one, self.other = (nn.Parameter(torch.zeros(1)) for _ in range(3))


AT_ONCE = (("a", "b"), (3, 4, 4))
IN_TURN = ((("a",), (3, 4, 4)), (("b",), (12, 0, 5)))
ROOT = 41**0.5


@pytest.mark.parametrize(
    ("phases", "limit", "ends", "norms"),
    [
        # The norm of 3, 4 and 4 is the root of 41; the shared parameter is stepped twice with it.
        ((AT_ONCE,), 1.0, (-6 / ROOT, -4 / ROOT, -4 / ROOT), {"/a+b": ROOT}),
        ((AT_ONCE,), None, (-6, -4, -4), {"/a+b": ROOT}),
        ((AT_ONCE,), 7.0, (-6, -4, -4), {"/a+b": ROOT}),
        # 3 and 4 of 5; then 12 and 5 of 13, what "a" left of the other head being cleared.
        (IN_TURN, 1.0, (-3 / 5 - 12 / 13, -4 / 5, -5 / 13), {"/a": 5, "/b": 13}),
        # The only optimiser clips all it has.
        (((("all",), (3, 4, 4)),), 1.0, (-3 / ROOT, -4 / ROOT, -4 / ROOT), {"": ROOT}),
    ],
)
def test_gradients_are_clipped_once_per_phase(
    tmp_path: Path,
    phases: tuple[tuple[tuple[str, ...], tuple[int, ...]], ...],
    limit: float | None,
    ends: tuple[float, ...],
    norms: dict[str, float],
) -> None:
    trainer, log = make(tmp_path, max_steps=1, clip_norm=limit)
    model = Heads()
    parts = {"a": [model.shared, model.one], "b": [model.shared, model.other]}
    if phases[0][0] == ("all",):
        parts = {"all": list(model.parameters())}
    groups = {name: [{"params": part, "base_lr": 1.0}] for name, part in parts.items()}
    trainer.optimizers = {name: torch.optim.SGD(each, lr=1.0) for name, each in groups.items()}
    trainer.model = model

    def scheme(batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        for names, gradients in phases:
            pairs = zip(gradients, model.parameters(), strict=True)
            yield Phase(names, {"fit": sum(factor * each for factor, each in pairs).sum()})

    trainer.scheme.phases = scheme
    trainer.fit(batches(0), State(seed=0))
    assert [each.item() for each in model.parameters()] == pytest.approx(list(ends), rel=1e-5)
    found = {name: value for name, value in log[0][1].items() if name.startswith("grad_norm")}
    assert found == {f"grad_norm{name}": pytest.approx(norm) for name, norm in norms.items()}
