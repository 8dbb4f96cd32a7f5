"""The training loop: backward, clip and step for every phase of the scheme."""

from __future__ import annotations

import math
import resource
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Protocol

import torch
from lightning_fabric import Fabric
from torch import Tensor, distributed, nn

from rgbt.checks import InputError, RunError, not_finite
from rgbt.engine.batch_norm import share_running_statistics
from rgbt.engine.checkpoint import (
    Checkpoints,
    EvaluatedWeights,
    State,
    check_origin,
    restore_optimizer,
    restore_weights,
    training_payload,
)
from rgbt.engine.optimizers import step_without_gradient
from rgbt.engine.progress import Pace, progress
from rgbt.engine.schedules import Schedule
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import agreed, collected, largest, mean_count, num_processes, rank
from rgbt.randomness import generators_of_step
from rgbt.runtime.signals import Stopped, at_once, deferred, ending_command, noted, raise_noted
from rgbt.types import Batch, GeneratorOf, Phase, TwoDomains

StepData = Batch | TwoDomains
Values = dict[str, float]

WAIT_SHARE = "wait_share"  # share of a step spent waiting for its images
ADVICE = "Lower optimizer.lr, or set trainer.precision=32-true; the last checkpoint is kept."


class Loaded(Protocol):
    """The data of a step, before it is on the device."""

    @property
    def name(self) -> tuple[str, ...]:
        """Names of all samples."""

    def to(self, device: torch.device | str) -> StepData:
        """The data of the step on `device`, with images as float32 in [0, 1]."""


class Scheme(Protocol):
    """The interface of a scheme for the loop."""

    def phases(self, batch: StepData, generator_of: GeneratorOf, /) -> Iterator[Phase]:
        """The backward passes of one step, in order."""


@dataclass(kw_only=True, eq=False)
class Trainer:
    """Runs a scheme to its last step, with evaluations and checkpoints in `folder`.

    Of several processes, each has one, with its part of every batch; process 0 writes.

    Attributes:
        others: further modules of the scheme (such as a discriminator), by name in checkpoints.
        record: called with (step, values) every `settings.log_every` steps.
        validate: called with the step; evaluates `weights.network` and returns the score that
            selects the best checkpoint. None: the weights of the last step are the best.
        keep: called where the weights just evaluated are the best, before they are saved.
        committed: called after an evaluation has been committed.
        after_step: called before the evaluation of a step; a signal interrupts it.
    """

    fabric: Fabric
    settings: TrainerSettings
    scheme: Scheme
    model: nn.Module
    others: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    schedule: Schedule
    steps_per_epoch: int
    folder: Path
    record: Callable[[int, Values], None]
    validate: Callable[[int], float] | None
    keep: Callable[[], None] = lambda: None
    committed: Callable[[], None] = lambda: None
    after_step: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.checkpoints = Checkpoints(self.folder)
        self.weights = EvaluatedWeights(self.model, self.settings)
        self.pace = Pace(self.settings.threads)

    def resume(self, state: State) -> bool:
        """Restore everything from the last checkpoint into `state`; False if there is none.

        RunError: the checkpoints are damaged; InputError: they are of another configuration.
        """
        source = self.checkpoints.last
        if not agreed(source.exists()):
            return False
        payload, stored = self.checkpoints.load()
        check_origin(payload, source, state.key, state.settings)
        others, optimizers = payload.get("others", {}), payload.get("optimizers", {})
        if others.keys() != self.others.keys() or optimizers.keys() != self.optimizers.keys():
            raise InputError(f"{source} is a checkpoint of other networks than those of this run.")
        self.weights.restore(payload, source)
        for name, module in self.others.items():
            restore_weights(module, others[name], source)
        for name, optimizer in self.optimizers.items():
            restore_optimizer(optimizer, optimizers[name], source)
        vars(state).update(vars(stored))
        return True

    def fit(self, batches: Iterator[Loaded], state: State) -> None:
        """Train from ``state.step`` to the last step with batches from there, updating `state`.

        Raises:
            RunError: a loss part, the gradient or a weight is not finite.
            Stopped: a signal came; it waits for the step, and its `step` is saved.
        """
        total = self.settings.max_steps
        with progress() as display, deferred():
            task = display.add_task("training", total=total, completed=state.step, note="")
            if self._is_due(state):  # a signal came before its evaluation
                self._evaluate_and_save(state)
            self.model.train()
            for step in range(state.step, total):
                # Steps may alternate between phases: a line has the last values of each.
                values = self._step(step, batches, state.seed)
                state.unlogged |= values
                state.step = step + 1
                self.weights.update(state.step)
                note = f"loss {values['loss']:.3f}  {values['images_per_s']:.1f} images/s"
                display.update(task, completed=state.step, note=note)
                if state.step % self.settings.log_every == 0 or state.step == total:
                    self.record(state.step, state.unlogged)
                    state.unlogged = {}
                self._evaluate_and_save(state)

    def _is_due(self, state: State) -> bool:
        """Whether the weights of this step are to be evaluated."""
        is_last = state.step == self.settings.max_steps
        is_step = is_last or state.step % self.settings.eval_every == 0
        return is_step and state.evaluated_step < state.step

    def _evaluate_and_save(self, state: State) -> None:
        """Evaluate and save if this step is due; save and stop if a signal came to any process."""
        due, signalled = self._is_due(state), largest(noted())
        saves = due or state.step % self.settings.checkpoint_every == 0
        if saves or signalled:
            self._exchange(state)
        if due and rank() == 0:
            self._check_weights(state)
        try:
            raise_noted(signalled)
            if rank() == 0:  # a signal to another process alone waits for the next step
                with at_once():
                    self.after_step()
            if due:
                with ending_command():  # another process may have left its evaluation before
                    self._select(state)
            if saves:
                self._save(state)
            if due:
                self.model.train()
            if due and rank() == 0:
                with at_once():
                    self.committed()
        except Stopped as stop:
            self._save(state)
            stop.step = state.step
            raise

    def _select(self, state: State) -> None:
        """Evaluate, and keep the weights if they are the best so far or if the last are tested.

        So are the last where the score is undefined (NaN), as of labels of one class.
        """
        keeps = state.step == self.settings.max_steps
        if self.validate is not None:
            with at_once():
                score = self.validate(state.step)
            keeps = score > state.best_score or self.settings.tested == "last"
            state.best_score = score if keeps else state.best_score
            keeps |= math.isnan(score)
        if keeps:
            state.best_step = state.step
            self.keep()
        state.evaluated_step = state.step

    def _exchange(self, state: State) -> None:
        """Collect what every process has by itself, before process 0 saves it."""
        for names in collected(state.skipped):
            state.skip(names)
        if self.settings.batch_norm_parts > 1:
            for module in (self.model, self.weights.network, *self.others.values()):
                share_running_statistics(module)

    def _check_weights(self, state: State) -> None:
        """Refuse to evaluate or save parameters and buffers that are not finite, by RunError."""
        for module in (self.model, *self.others.values()):
            for name in not_finite(module.state_dict()):
                raise RunError(f"step {state.step}: '{name}' holds NaN or infinity. {ADVICE}")

    def _save(self, state: State) -> None:
        if rank() == 0:
            self._check_weights(state)
            weights = self.weights.state()
            payload = training_payload(weights, self.others, self.optimizers, state)
            self.checkpoints.commit(payload, state)

    def _step(self, step: int, batches: Iterator[Loaded], seed: int) -> Values:
        """One optimizer step of every phase; returns the values to record."""
        started = time.perf_counter()
        factor = self.schedule(step, self.settings.max_steps, self.steps_per_epoch)
        values: Values = {}
        rates = {}
        for name, optimizer in self.optimizers.items():
            for index, group in enumerate(optimizer.param_groups):
                share = 1.0 if "constant" in group else factor
                group["lr"] = rates[f"lr/{name}_{index}"] = group["base_lr"] * share
        micro = [next(batches) for _ in range(self.settings.accumulate)]
        waited = time.perf_counter() - started
        device = self.fabric.device
        parts = [
            self.scheme.phases(batch.to(device), generators_of_step(seed, index, device))
            for index, batch in enumerate(micro, start=step * self.settings.accumulate)
        ]
        try:
            for phase in parts[0]:
                # A phase of all batches ends before the next one of any begins: that one may
                # read, or clear, what this one stepped.
                _add(values, self._run_phase(phase, parts[1:]))
        except RunError as error:
            raise RunError(f"step {step + 1}: {error} {ADVICE}") from error
        elapsed = time.perf_counter() - started
        if rank() == 0:
            self.pace.add(elapsed, waited)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**10
        if device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(device) / 2**20
        images = num_processes() * sum(len(batch.name) for batch in micro)
        values |= {"images_per_s": images / elapsed, WAIT_SHARE: waited / elapsed}
        return values | rates | {"peak_memory_mib": peak}

    def _run_phase(self, phase: Phase, others: list[Iterator[Phase]]) -> Values:
        """Backward through a phase of every accumulated batch, then its optimisers' steps."""
        if phase.clear:
            for optimizer in self.optimizers.values():
                optimizer.zero_grad()
        stepped = [self.optimizers[name] for name in phase.optimizers]
        groups = [group["params"] for optimizer in stepped for group in optimizer.param_groups]
        # Once for all of them: what two optimisers share is clipped as one gradient.
        parameters = list({id(each): each for group in groups for each in group}.values())
        names, share = "+".join(phase.optimizers), 1.0 / self.settings.accumulate
        losses = [self._backward(each, share) for each in chain([phase], map(next, others))]
        average_gradients(parameters)
        norm = nn.utils.clip_grad_norm_(parameters, self.settings.clip_norm or math.inf)
        # One transfer for all values: each one would wait for the device.
        numbers = iter(torch.cat([*(values for _, values in losses), norm.reshape(1)]).tolist())
        logged: Values = {}
        for parts, _ in losses:
            values = {name: _finite(name, next(numbers)) for name in parts}
            beside = phase.logged  # no losses
            _add(logged, {n if n in beside else f"loss/{n}": v * share for n, v in values.items()})
            _add(logged, {"loss": sum(v for n, v in values.items() if n not in beside) * share})
        key = "grad_norm" if len(self.optimizers) == 1 else f"grad_norm/{names}"
        logged[key] = _finite("gradient norm", next(numbers))
        for optimizer in stepped:
            optimizer.step()
        for name in phase.idle:
            step_without_gradient(self.optimizers[name])
        return logged

    def _backward(self, phase: Phase, share: float) -> tuple[tuple[str, ...], Tensor]:
        """Backward through a phase; names and values to log, not read from the device yet."""
        parts = list(phase.parts.values())
        self.fabric.backward(torch.stack(parts).sum() * share)
        parts += phase.logged.values()
        values = torch.stack([part.detach().float() for part in parts])
        # Checked after the mean, so that all processes raise the same error.
        return (*phase.parts, *phase.logged), mean_count(values)


@torch.no_grad()
def average_gradients(parameters: Sequence[nn.Parameter]) -> None:
    """Replace each gradient by its mean over the processes, after the last pass of a phase.

    A step may have several forward passes, heads that one domain alone uses, and parameters that
    two optimizers step, unlike in DistributedDataParallel. What a parameter kept from an earlier
    phase is the mean already. No gradient is 0 where another process has one.
    """
    if num_processes() == 1:
        return
    used = mean_count(torch.tensor([each.grad is not None for each in parameters]))
    by_dtype: dict[torch.dtype, list[Tensor]] = {}
    for each, share in zip(parameters, used.tolist(), strict=True):
        if share:
            each.grad = torch.zeros_like(each) if each.grad is None else each.grad
            by_dtype.setdefault(each.dtype, []).append(each.grad)
    for gradients in by_dtype.values():
        flat = torch.cat([gradient.reshape(-1) for gradient in gradients])
        distributed.all_reduce(flat)
        flat /= num_processes()
        parts = torch.split(flat, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view(gradient.shape))


def _add(values: Values, more: Values) -> None:
    for name, value in more.items():
        values[name] = values.get(name, 0.0) + value


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise RunError(f"{name} is {value}.")
    return value
