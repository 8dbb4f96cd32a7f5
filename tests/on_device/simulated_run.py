"""Training steps and an evaluation of an experiment on the simulated device."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.data.loaders import eval_batches
from rgbt.evaluation.prediction import Predictor
from rgbt.evaluation.request import EvaluationRequest
from tests.benchmarks.gpu.project import Training, setup_of, smoke_words
from tests.on_device.simulated import DEVICE, simulation

CPU = torch.device("cpu")


@dataclass(frozen=True)
class SimulatedRun:
    """What was found.

    Attributes:
        losses: of each step.
        classes: of the pixels of the test split, by batch.
        step_waits: what the host waits for in one step, after the first, with the number of times.
        evaluation_waits: the same of one batch of the evaluation.
    """

    losses: list[float]
    classes: list[Tensor]
    step_waits: Counter[str]
    evaluation_waits: Counter[str]


def words_of(experiment: str) -> list[str]:
    """Overrides of a step at smoke size."""
    return list(smoke_words(experiment))


def on_cpu(words: Sequence[str], folder: Path, steps: int = 2) -> SimulatedRun:
    """The same steps on the CPU itself."""
    setup = setup_of(words, CPU)
    _not_fused(setup)
    training = Training(setup, folder)
    training.run(setup.batches(range(steps)), steps)
    losses = [each["loss"] for each in training.recorded]
    return SimulatedRun(losses, list(_classes(setup)), Counter(), Counter())


def simulated(words: Sequence[str], folder: Path, steps: int = 2) -> SimulatedRun:
    """Steps in the project's loop, and an evaluation of the test split.

    Raises:
        DeviceMismatchError: an operation on tensors of both devices.
    """
    setup = setup_of(words, CPU)
    _not_fused(setup)
    with simulation() as waits:
        _move(setup)
        fabric = SimpleNamespace(
            device=DEVICE, backward=lambda loss: loss.backward(), autocast=nullcontext
        )
        setup = replace(setup, fabric=fabric, session=replace(setup.session, device=DEVICE))
        training = Training(setup, folder)
        training.run(setup.batches(range(steps - 1)), steps - 1)
        before = waits.copy()
        training.run(setup.batches(range(steps - 1, steps)), 1)
        in_step = _ours(waits - before)
        losses = [each["loss"] for each in training.recorded]
        before = waits.copy()
        classes = list(_classes(setup))
        of_batch = _ours(waits - before)
    for line in of_batch:
        of_batch[line] = -(-of_batch[line] // len(classes))
    return SimulatedRun(losses, classes, in_step, of_batch)


def _not_fused(setup: TrainingSetup) -> None:
    """Let optimisers use plain operations: the simulated device has no kernels of its own."""
    for optimizer in setup.optimizers.values():
        for group in optimizer.param_groups:
            group |= {name: False for name in ("fused", "foreach") if name in group}


def _move(setup: TrainingSetup) -> None:
    """Move all networks, and let the optimisers have the parameters that they have there."""
    modules: list[nn.Module] = [setup.session.model, *setup.others.values()]
    old = [each for module in modules for each in module.parameters()]
    for module in modules:
        module.to(DEVICE)
    new = [each for module in modules for each in module.parameters()]
    there = {id(each): moved for each, moved in zip(old, new, strict=True)}
    for optimizer in setup.optimizers.values():
        for group in optimizer.param_groups:
            group["params"] = [there[id(each)] for each in group["params"]]


def _classes(setup: TrainingSetup) -> Iterator[Tensor]:
    session: Any = setup.session
    predictor = Predictor(session, setup.model, EvaluationRequest(split="test"))
    for batch in eval_batches(session.dataset, "test", session.transform, session.loading):
        yield predictor.classes(batch.to(session.device)).cpu()


def _ours(waits: Counter[str]) -> Counter[str]:
    """Those that our code asks for, not this simulation."""
    return Counter({line: count for line, count in waits.items() if line.startswith("rgbt/")})
