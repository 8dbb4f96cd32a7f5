"""The training loop: backward, clip and step for every phase of the scheme.

`Trainer` is read from top to bottom: resume, loop, step, phase, evaluation, checkpoint. What a run
adds to its steps are the methods of one object, `Hooks`.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checks import InputError, RunError, of_posix
from rgbt.engine.batch_norm import share_running_statistics
from rgbt.engine.checkpoint import (
    ADVICE,
    BEST,
    LAST,
    Best,
    EvaluatedWeights,
    State,
    best_payload,
    check_finite,
    check_origin,
    commit,
    load_last,
    restore_optimizer,
    restore_weights,
    training_payload,
)
from rgbt.engine.device import compiles_functions
from rgbt.engine.host_copy import Copies, copied, reserve
from rgbt.engine.optimizers import step_without_gradient
from rgbt.engine.progress import training_log, watch_pace, write_evaluation
from rgbt.engine.schedules import Schedule
from rgbt.engine.settings import TrainerSettings
from rgbt.fusion import compile_fused
from rgbt.processes import (
    average_gradients,
    collected,
    computed_once,
    largest,
    mean_count,
    num_processes,
)
from rgbt.randomness import generators_of_step
from rgbt.runtime.signals import Stopped, at_once, deferred, ending_command, noted, raise_noted
from rgbt.terminal import progress
from rgbt.types import Batch, GeneratorOf, Phase, TwoDomains

StepData = Batch | TwoDomains
Values = dict[str, float]

# What the loop calls of a scheme: the backward passes of one step, in order.
Phases = Callable[[StepData, GeneratorOf], Iterator[Phase]]

WAIT_SHARE = "wait_share"  # share of a step spent waiting for its images


class Hooks:
    """Lets a run act around its steps, in the order of these methods; they do nothing here.

    Of several processes, each calls `log`, `evaluate` and `keep`; `after_step` and `show` are
    called by the process that writes.
    """

    def log(self, step: int, values: Values) -> None:
        """Record the values of the last steps; called every `log_every` steps."""

    def after_step(self) -> None:
        """Do what may take long after a step, and before its evaluation; a signal interrupts it."""

    def evaluate(self, step: int, network: nn.Module) -> float | None:  # noqa: ARG002
        """Evaluate `network`, and return the score that selects the best checkpoint.

        None: there is none, and the weights of the last step are the best.
        """
        return None

    def keep(self) -> Callable[[Path], None]:
        """Return what writes the files of this evaluation, whose weights are the best, to a folder.

        A thread calls it with the next checkpoint.
        """
        return lambda _: None

    def show(self) -> None:
        """Show what is new after an evaluation; a signal interrupts it."""


@dataclass(kw_only=True, eq=False)
class Trainer:
    """Runs a scheme to its last step, with evaluations and checkpoints in `folder`.

    Of several processes, each has one, with its part of every batch.

    Attributes:
        phases: of the scheme that is trained.
        others: further modules of the scheme (such as a discriminator), by name in checkpoints.
        hooks: what the run does around its steps.
        writes: whether this process writes the files of the run.
    """

    fabric: Fabric
    settings: TrainerSettings
    phases: Phases
    model: nn.Module
    others: dict[str, nn.Module]
    optimizers: dict[str, torch.optim.Optimizer]
    schedule: Schedule
    steps_per_epoch: int
    folder: Path
    hooks: Hooks
    writes: bool = True

    def __post_init__(self) -> None:
        self.weights = EvaluatedWeights(self.model, self.settings)
        self.note_pace = watch_pace(self.settings.threads)
        self._copies: Copies = {}  # what is being written, and the best weights
        self._best: Best | None = None  # to be written with the next checkpoint
        self._thread: ThreadPoolExecutor
        self._writing: Future[Any] | None = None
        self._saved_at = time.monotonic()

    def resume(self, state: State) -> bool:
        """Restore everything from the last checkpoint into `state`; False if there is none.

        RunError: the checkpoints are damaged; InputError: they are of another configuration.
        """
        source = self.folder / LAST
        if not computed_once(source.exists):
            return False
        payload, stored = load_last(self.folder)
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

    def fit(self, batches: Iterator[StepData], state: State) -> None:
        """Train from ``state.step`` to the last step with batches from there, updating `state`.

        The batches are as a loader makes them, not on the device yet.

        Raises:
            RunError: a loss part, the gradient or a weight is not finite.
            Stopped: a signal came; it waits for the step, and its `step` is saved.
        """
        total = self.settings.max_steps
        begun_at, first, write = time.monotonic(), state.step, training_log(total)
        self._saved_at = begun_at
        functions = compile_fused(compiles_functions(self.settings, self.fabric.device))
        with progress() as display, deferred(), ThreadPoolExecutor(1) as self._thread, functions:
            task = display.add_task("training", total=total, completed=first, note="")
            if self._is_due(state):  # a signal came before its evaluation
                self._evaluate_and_save(state)
            self.model.train()
            for step in range(first, total):
                values = self._step(step, batches, state.seed)
                state.step = step + 1
                self.weights.update(state.step)
                if step == first and self.writes:
                    self._writing = self._thread.submit(reserve(self._saved(state), self._copies))
                done = (state.step - first) / (total - first)
                values["seconds_left"] = (time.monotonic() - begun_at) * (1 / done - 1)
                note = f"loss {values['loss']:.3f}  {values['images_per_s']:.1f} images/s"
                display.update(task, completed=state.step, note=note)
                # Steps may alternate between phases: a line has the last values of each.
                state.unlogged |= values
                if state.step % self.settings.log_every == 0 or state.step == total:
                    self.hooks.log(state.step, state.unlogged)
                    write(state.step, state.unlogged)
                    state.unlogged = {}
                self._evaluate_and_save(state)
            self._wait()
            self._copies = {}

    def _step(self, step: int, batches: Iterator[StepData], seed: int) -> Values:
        """Make one optimizer step of every phase; returns the values to log."""
        started = time.perf_counter()
        rates = self._set_rates(step)
        loaded = [next(batches) for _ in range(self.settings.accumulate)]
        waited = time.perf_counter() - started
        device = self.fabric.device
        phases_of_batches = []
        for index, batch in enumerate(loaded, start=step * self.settings.accumulate):
            generator_of = generators_of_step(seed, index, device)
            phases_of_batches.append(self.phases(batch.to(device), generator_of))
        first, *others = phases_of_batches
        values: Values = {}
        try:
            for phase in first:
                # A phase of all batches ends before the next one of any begins: that one may
                # read, or clear, what this one stepped.
                _add(values, self._run_phase(phase, others))
        except RunError as error:
            raise RunError(f"step {step + 1}: {error} {ADVICE}") from error
        elapsed = time.perf_counter() - started
        self.note_pace(elapsed, waited)
        resource = of_posix("resource", "the peak memory of a training")
        unit = 2**20 if sys.platform == "darwin" else 2**10  # bytes; KiB
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit
        if device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(device) / 2**20
        images = num_processes() * sum(len(batch.name) for batch in loaded)
        values |= {"images_per_s": images / elapsed, WAIT_SHARE: waited / elapsed}
        return values | rates | {"peak_memory_mib": peak}

    def _set_rates(self, step: int) -> Values:
        """Set the learning rates of a step; returns them by name."""
        factor = self.schedule(step, self.settings.max_steps, self.steps_per_epoch)
        rates: Values = {}
        for name, optimizer in self.optimizers.items():
            for index, group in enumerate(optimizer.param_groups):
                share = 1.0 if "constant" in group else factor
                group["lr"] = rates[f"lr/{name}_{index}"] = group["base_lr"] * share
        return rates

    def _run_phase(self, phase: Phase, others: list[Iterator[Phase]]) -> Values:
        """Go backward through a phase of every accumulated batch, then step its optimisers."""
        if phase.clear:
            for optimizer in self.optimizers.values():
                optimizer.zero_grad()
        share = 1.0 / self.settings.accumulate
        losses = [self._backward(phase, share)]
        for phases in others:
            losses.append(self._backward(next(phases), share))
        stepped = [self.optimizers[name] for name in phase.optimizers]
        # Once for all of them: what two optimisers share is clipped as one gradient.
        distinct: dict[int, nn.Parameter] = {}
        for optimizer in stepped:
            for group in optimizer.param_groups:
                distinct |= {id(parameter): parameter for parameter in group["params"]}
        parameters = list(distinct.values())
        average_gradients(parameters)
        norm = nn.utils.clip_grad_norm_(parameters, self.settings.clip_norm or math.inf)
        # One transfer for all values: each one would wait for the device.
        numbers = iter(torch.cat([*(values for _, values in losses), norm.reshape(1)]).tolist())
        logged: Values = {}
        for names, _ in losses:
            values = {name: _finite(name, next(numbers)) for name in names}
            beside = {name: values.pop(name) for name in names if name in phase.logged}
            # What is logged beside the parts is no loss.
            _add(logged, {f"loss/{name}": value * share for name, value in values.items()})
            _add(logged, {name: value * share for name, value in beside.items()})
            _add(logged, {"loss": sum(values.values()) * share})
        key = "grad_norm"
        if len(self.optimizers) > 1:
            key = f"grad_norm/{'+'.join(phase.optimizers)}"
        logged[key] = _finite("gradient norm", next(numbers))
        for optimizer in stepped:
            optimizer.step()
        for name in phase.idle:
            step_without_gradient(self.optimizers[name])
        return logged

    def _backward(self, phase: Phase, share: float) -> tuple[tuple[str, ...], Tensor]:
        """Go backward through a phase; returns names and values, not read from the device yet."""
        parts = list(phase.parts.values())
        self.fabric.backward(torch.stack(parts).sum() * share)
        parts += phase.logged.values()
        values = torch.stack([part.detach().float() for part in parts])
        # Checked after the mean, so that all processes raise the same error.
        return (*phase.parts, *phase.logged), mean_count(values)

    def _is_due(self, state: State) -> bool:
        """Whether the weights of this step are to be evaluated."""
        is_last = state.step == self.settings.max_steps
        is_step = is_last or state.step % self.settings.eval_every == 0
        return is_step and state.evaluated_step < state.step

    def _evaluate_and_save(self, state: State) -> None:
        """Evaluate and save if this step is due; save and stop if a signal came to any process."""
        due, request = self._is_due(state), largest(self._request())
        signalled = max(0, request - 1)
        is_last = state.step == self.settings.max_steps
        saves = bool(request) or (due and (is_last or self.settings.checkpoint_evaluations))
        if due or saves:
            self._exchange(state)
        if due:
            for module in (self.model, *self.others.values()):
                check_finite(module.state_dict(), state.step)
        try:
            raise_noted(signalled)
            if self.writes:  # a signal to another process alone waits for the next step
                with at_once():
                    self.hooks.after_step()
            if due:
                with ending_command():  # another process may have left its evaluation before
                    self._select(state)
            if saves:
                self._save(state)
            if due:
                self.model.train()
            if due and self.writes:
                with at_once():
                    self.hooks.show()
        except Stopped as stop:
            self._save(state)
            self._wait()
            stop.step = state.step
            raise

    def _request(self) -> int:
        """Return 1 + the number of a signal, else 1 where a checkpoint is due by time, or 0."""
        if self._writing is not None and self._writing.done():
            self._wait()
        if number := noted():
            return 1 + number
        wanted, minutes = self.settings.checkpoint_minutes, (time.monotonic() - self._saved_at) / 60
        is_free = self._writing is None or wanted == 0  # else it is put off
        return int(self.writes and is_free and minutes >= wanted)

    def _exchange(self, state: State) -> None:
        """Collect what every process has by itself, before it is saved."""
        for names in collected(state.skipped):
            state.skip(names)
        if self.settings.batch_norm_parts > 1:
            for module in (self.model, self.weights.network, *self.others.values()):
                share_running_statistics(module)

    def _select(self, state: State) -> None:
        """Evaluate, and keep the weights if they are the best so far or if the last are tested.

        So are the last where the score is undefined (NaN), as of labels of one class.
        """
        with at_once(), compile_fused(False):  # the sizes of its images may differ
            score = self.hooks.evaluate(state.step, self.weights.network)
        if score is None:
            keeps = state.step == self.settings.max_steps
        else:
            keeps = score > state.best_score or self.settings.tested == "last"
            state.best_score = score if keeps else state.best_score
            keeps |= math.isnan(score)
        if keeps:
            state.best_step = state.step
            self._keep(state, self.hooks.keep())
        state.evaluated_step = state.step
        if score is not None and self.writes:
            split, best = self.settings.selection_split, (state.best_score, state.best_step)
            write_evaluation(state.step, self.settings.max_steps, split, score, best)

    def _keep(self, state: State, write_files: Callable[[Path], None]) -> None:
        """Copy the weights of this evaluation, which the next checkpoint names as the best."""
        if self.writes:
            self._wait()  # for the thread that may be writing those of the last one
            weights = copied({BEST: self.weights.network.state_dict()}, self._copies)[BEST]
            self._best = best_payload(weights, state), write_files

    def _save(self, state: State) -> None:
        """Copy the state of this step, in the process that writes, and let the thread write it."""
        if not self.writes:
            return
        self._wait()
        payload = copied({LAST: self._saved(state)[LAST]}, self._copies)[LAST]
        self._writing = self._thread.submit(commit, self.folder, payload, self._best)
        self._best, self._saved_at = None, time.monotonic()
        if self.settings.checkpoint_minutes == 0:
            self._wait()

    def _saved(self, state: State) -> dict[str, Any]:
        """Return what the two files hold, on the device."""
        weights = self.weights.state()
        payload = training_payload(weights, self.others, self.optimizers, state)
        return {LAST: payload, BEST: weights["model"]}

    def _wait(self) -> None:
        """Wait until the thread has written its files, and raise its error if there is one."""
        writing, self._writing = self._writing, None
        if writing is not None:
            writing.result()


def _add(values: Values, more: Values) -> None:
    for name, value in more.items():
        values[name] = values.get(name, 0.0) + value


def _finite(name: str, value: float) -> float:
    if not math.isfinite(value):
        raise RunError(f"{name} is {value}.")
    return value
