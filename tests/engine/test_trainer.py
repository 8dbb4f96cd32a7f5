"""The loop: it learns, resumes to the same bits, accumulates, and stops on non-finite values."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checkpoints.stored import save
from rgbt.checks import InputError, RunError
from rgbt.engine.checkpoint import State, load_checkpoint, restore_weights
from rgbt.engine.optimizers import SGD, Adam, AdamW
from rgbt.engine.schedules import Exponential, Poly
from rgbt.engine.settings import TrainerSettings
from rgbt.engine.trainer import Trainer
from rgbt.randomness import torch_generator
from rgbt.requirements import Record
from rgbt.types import Batch, GeneratorOf, Phase

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
        yield Phase(("main",), {"fit": loss, "extra": 0 * loss})


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
    state = State(seed=7)
    interrupted = batches(0)

    def stop_after_five() -> Iterator[Batch]:
        for _ in range(5):
            yield next(interrupted)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        first.fit(stop_after_five(), state)

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


def test_accumulated_halves_equal_the_whole_batch(tmp_path: Path) -> None:
    whole, _ = make(tmp_path / "whole", max_steps=1)
    split, _ = make(tmp_path / "split", max_steps=1, accumulate=2)
    for trainer, source in ((whole, batches(0)), (split, halves())):
        trainer.scheme.phases = quiet(trainer.model)
        trainer.fit(source, State(seed=0))
    for a, b in zip(whole.model.parameters(), split.model.parameters(), strict=True):
        torch.testing.assert_close(a, b)


def quiet(model: nn.Module):
    def phases(batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        guess = model(batch.rgb.mean((2, 3)))
        target = batch.rgb.mean((1, 2, 3))[:, None]
        yield Phase(("main",), {"fit": (guess - target).square().mean()})

    return phases


def test_a_value_that_is_not_finite_stops_the_run_and_is_named(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, poison=3)
    before = [p.clone() for p in trainer.model.parameters()]
    with pytest.raises(RunError, match=r"step 4: fit is nan"):
        trainer.fit(batches(0), State(seed=0))
    assert all(torch.isfinite(p).all() for p in trainer.model.parameters())
    assert any(not torch.equal(a, b) for a, b in zip(before, trainer.model.parameters()))


def test_schedule_values() -> None:
    iteration = Poly(power=1.0, per="iteration", warmup_steps=0)
    assert [iteration(s, 4, 2) for s in range(4)] == [1.0, 0.75, 0.5, 0.25]
    # As released: 312 epochs of 112 iterations against a total of 35000 iterations.
    released = Poly(power=0.9, per="epoch", warmup_steps=0)
    assert released(34999, 35000, 112) == pytest.approx(0.992, abs=5e-4)
    warm = Poly(power=0.9, per="iteration", warmup_steps=4)
    assert warm(0, 10**9, 1) == pytest.approx(0.25)
    assert warm(3, 10**9, 1) == pytest.approx(1.0)
    # Temporal release: 6e-5 at the end of the warm-up, then 5.72931e-5 at step 18740 of 374800.
    temporal = Poly(power=0.9, per="iteration", warmup_steps=18740)
    assert 6e-5 * temporal(18739, 374800, 1) == pytest.approx(6e-5)
    assert 6e-5 * temporal(18740, 374800, 1) == pytest.approx(5.72931e-5, rel=1e-5)


def test_parameter_groups_decay_weights_and_biases_but_not_norms_and_embeddings() -> None:
    model = nn.ModuleDict({"backbone": nn.Linear(2, 2), "norm": nn.LayerNorm(2)})
    model["query"] = nn.Embedding(3, 2)
    model.record = Record(pretrained_parts=("backbone.",))
    builder = AdamW(
        lr=1.0,
        backbone_multiplier=0.1,
        weight_decay=0.5,
        decay_biases=True,
        betas=(0.9, 0.999),
        eps=1e-8,
    )
    groups = builder(model).param_groups
    found = {(g["lr"], g["weight_decay"]): sum(p.numel() for p in g["params"]) for g in groups}
    assert found == {(0.1, 0.5): 6, (1.0, 0.0): 4 + 6}


def test_biases_are_left_undecayed_where_asked() -> None:
    builder = AdamW(
        lr=1.0,
        backbone_multiplier=1.0,
        weight_decay=0.5,
        decay_biases=False,
        betas=(0.9, 0.999),
        eps=1e-8,
    )
    groups = builder(nn.Linear(3, 2)).param_groups
    assert {g["weight_decay"]: [p.shape for p in g["params"]] for g in groups} == {
        0.5: [(2, 3)],
        0.0: [(2,)],
    }


def test_sgd_steps_as_written_and_decays_everything() -> None:
    model = nn.ModuleDict({"backbone": nn.Linear(1, 1), "norm": nn.BatchNorm1d(1)})
    model.record = Record(pretrained_parts=("backbone.",))
    for parameter in model.parameters():
        nn.init.constant_(parameter, 2.0)
        parameter.grad = torch.ones_like(parameter)
    optimizer = SGD(lr=0.1, backbone_multiplier=0.5, momentum=0.9, weight_decay=0.25)(model)
    optimizer.step()
    # 2 - lr (1 + 0.25 * 2): 0.05 for the backbone, 0.1 for the rest.
    assert model["backbone"].weight.item() == pytest.approx(2 - 0.05 * 1.5)
    assert model["backbone"].bias.item() == pytest.approx(2 - 0.05 * 1.5)
    assert model["norm"].weight.item() == pytest.approx(2 - 0.1 * 1.5)
    assert sorted(g["base_lr"] for g in optimizer.param_groups) == [0.05, 0.1]


def test_exponential_falls_by_the_epoch() -> None:
    own, longer = (Exponential(factor=0.5, epoch_steps=steps) for steps in (None, 6))
    assert [own(step, 100, 3) for step in range(7)] == [1, 1, 1, 0.5, 0.5, 0.5, 0.25]
    assert [longer(step, 100, 3) for step in range(7)] == [1] * 6 + [0.5]


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
    said = rf"step {poisoned}: '2.bias' holds NaN or infinity \(1 of 6 tensors do\)\. The last"
    with pytest.raises(RunError, match=said):
        trainer.fit(batches(0), State(seed=7))
    assert evaluated == []
    # Step 2 writes a checkpoint, step 3 would evaluate.
    assert trainer.checkpoints.last.exists() == (poisoned == 3)


def test_checkpoint_of_another_model_is_refused_with_the_keys(tmp_path: Path) -> None:
    path = tmp_path / "other.pt"
    save(path, {"model": nn.Linear(2, 3).state_dict()})
    weights = load_checkpoint(path)["model"]
    with pytest.raises(InputError, match=r"another model: 0 keys missing.*weight"):
        restore_weights(nn.Linear(2, 4), weights, path)
    with pytest.raises(InputError, match=r"1 keys unexpected \(bias\)"):
        restore_weights(nn.Linear(2, 3, bias=False), weights, path)


def test_a_file_that_is_no_checkpoint_is_refused(tmp_path: Path) -> None:
    broken = tmp_path / "broken.pt"
    broken.write_bytes(b"not a checkpoint")
    with pytest.raises(InputError, match="is no file of weights"):
        load_checkpoint(broken)
    with pytest.raises(InputError, match="no such checkpoint"):
        load_checkpoint(tmp_path / "missing.pt")


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
        assert_equal(ends[0][part], ends[1][part])
    assert set(ends[0]["others"]) == {"judge"}
    assert "1.running_mean" in ends[0]["others"]["judge"]
    assert [v["loss"] for _, v in straight.log[4:]] == [v["loss"] for _, v in second.log]
    assert {"loss/fit", "loss/judge", "grad_norm/main", "grad_norm/judge"} <= set(
        straight.log[0][1]
    )
    assert straight.log[0][1]["loss"] == pytest.approx(
        straight.log[0][1]["loss/fit"] + straight.log[0][1]["loss/judge"]
    )


def assert_equal(one: object, other: object) -> None:
    if isinstance(one, torch.Tensor):
        assert torch.equal(one, other)
    elif isinstance(one, dict):
        assert one.keys() == other.keys()
        for key in one:
            assert_equal(one[key], other[key])
    elif isinstance(one, list):
        assert len(one) == len(other)
        for a, b in zip(one, other, strict=True):
            assert_equal(a, b)
    else:
        assert one == other


def test_a_checkpoint_keeps_no_critic_from_before_there_was_one(tmp_path: Path) -> None:
    trainer, _ = make(tmp_path, max_steps=2)
    trainer.fit(batches(0), State(seed=0))
    payload = load_checkpoint(tmp_path / "last.pt")
    del payload["others"]  # as checkpoints were before
    save(tmp_path / "last.pt", payload)
    again, _ = make(tmp_path)
    state = State(seed=0)
    assert again.resume(state)
    assert state.step == 2


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
        trainer, _ = make(tmp_path / where, max_steps=2, accumulate=accumulate, clip_norm=clip_norm)
        trainer.scheme = Shared(trainer.model, clear)
        builder = SGD(lr=0.05, backbone_multiplier=1.0, momentum=0.9, weight_decay=0.01)
        trainer.optimizers = {"main": builder(trainer.model), "second": builder(trainer.model)}
        trainer.fit(batches(0) if accumulate == 1 else halves(), State(seed=0))
        found.append([p.detach().clone() for p in trainer.model.parameters()])
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
    """Parameters with the gradients 3 (shared), 4 and 4, whatever is seen."""

    def __init__(self) -> None:
        super().__init__()
        self.shared, self.one, self.other = (nn.Parameter(torch.zeros(1)) for _ in range(3))

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        del batch, generator_of
        yield Phase(self.named, {"fit": (3 * self.shared + 4 * self.one + 4 * self.other).sum()})


def make_heads(folder: Path, named: tuple[str, ...], **changes: object) -> tuple[Heads, list]:
    trainer, log = make(folder, max_steps=1, **changes)
    model = Heads()
    model.named = named
    parts = {"a": [model.shared, model.one], "b": [model.shared, model.other]}
    if len(named) == 1:
        parts = {"main": list(model.parameters())}
    trainer.model, trainer.scheme = model, model
    groups = {name: [{"params": part, "base_lr": 1.0}] for name, part in parts.items()}
    trainer.optimizers = {name: torch.optim.SGD(each, lr=1.0) for name, each in groups.items()}
    trainer.fit(batches(0), State(seed=0))
    return model, log


@pytest.mark.parametrize(("limit", "factor"), [(1.0, 1 / 41**0.5), (None, 1.0), (7.0, 1.0)])
def test_what_two_optimisers_step_is_clipped_once(
    tmp_path: Path, limit: float | None, factor: float
) -> None:
    """The norm of 3, 4 and 4 is the root of 41; the shared parameter is stepped twice with it."""
    model, log = make_heads(tmp_path, ("a", "b"), clip_norm=limit)
    assert model.shared.item() == pytest.approx(-2 * 3 * factor, rel=1e-5)
    assert model.one.item() == pytest.approx(-4 * factor, rel=1e-5)
    assert model.other.item() == pytest.approx(-4 * factor, rel=1e-5)
    norms = {name: value for name, value in log[0][1].items() if name.startswith("grad_norm")}
    assert norms == {"grad_norm/a+b": pytest.approx(41**0.5)}


def test_what_one_optimiser_of_two_steps_is_its_own_norm(tmp_path: Path) -> None:
    trainer, log = make(tmp_path, max_steps=1, clip_norm=1.0)
    model = Heads()

    def phases(batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        del batch, generator_of
        yield Phase(("a",), {"fit": (3 * model.shared + 4 * model.one + 4 * model.other).sum()})
        yield Phase(("b",), {"fit": (12 * model.shared + 5 * model.other).sum()})

    model.phases = phases
    trainer.model, trainer.scheme = model, model
    parts = {"a": [model.shared, model.one], "b": [model.shared, model.other]}
    groups = {name: [{"params": part, "base_lr": 1.0}] for name, part in parts.items()}
    trainer.optimizers = {name: torch.optim.SGD(each, lr=1.0) for name, each in groups.items()}
    trainer.fit(batches(0), State(seed=0))
    # 3 and 4 of 5; then 12 and 5 of 13, what "a" left of the other head being cleared.
    assert model.shared.item() == pytest.approx(-3 / 5 - 12 / 13, rel=1e-5)
    assert model.one.item() == pytest.approx(-4 / 5, rel=1e-5)
    assert model.other.item() == pytest.approx(-5 / 13, rel=1e-5)
    assert log[0][1]["grad_norm/a"] == pytest.approx(5)
    assert log[0][1]["grad_norm/b"] == pytest.approx(13)


def test_the_only_optimiser_clips_all_it_has(tmp_path: Path) -> None:
    model, log = make_heads(tmp_path, ("main",), clip_norm=1.0)
    found = [each.item() for each in (model.shared, model.one, model.other)]
    assert found == pytest.approx([-each / 41**0.5 for each in (3, 4, 4)], rel=1e-5)
    norms = {name: value for name, value in log[0][1].items() if name.startswith("grad_norm")}
    assert norms == {"grad_norm": pytest.approx(41**0.5)}
