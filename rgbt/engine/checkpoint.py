"""Checkpoints of a run: the state to resume from, and the best weights.

When a run starts, the first of these that exists is used:
1. ``last.pt`` of the run folder (the run resumes);
2. `model.weights` (read by `rgbt.weights`);
3. random weights.

``best.pt`` is written before the ``last.pt`` that names its step, each under a temporary name. A
process that is killed in between resumes from the state before, and makes the same best weights
again.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge
from pydantic import TypeAdapter
from torch import Tensor, nn

from rgbt.checkpoints.files import NOTE, is_plain, misfits, read_torch_file, save
from rgbt.checks import InputError, RunError, not_finite, one_line

UNAVERAGED = "unaveraged"
"""Entry of a checkpoint with the weights of the last step, where "model" has averaged ones."""

ADVICE = (
    "The last checkpoint is kept. Lower optimizer.lr, or use trainer.precision=32-true if the "
    "precision was mixed."
)
"""Advice for numbers that are not finite."""


Count = Annotated[int, Ge(0)]


@dataclass
class State:
    """Progress of a run. Generators need no entry: they are derived from seed and step.

    Attributes:
        step: optimiser steps done.
        best_score: highest selection score so far, fraction; -1 before the first evaluation, and
            in a run without a selection split.
        best_step: the step of the best score.
        seed: from which every generator of a step is derived, together with `step`: `seeds.masks`,
            or the seed of the run.
        skipped: names of the unreadable files that were skipped so far, sorted.
        evaluated_step: step of the last evaluation; below `step` where a signal came before the
            evaluation of `step`, which is then made on resuming.
        unlogged: values of the steps since the last line of ``metrics.jsonl``.
        key: of the run.
        settings: digest of its settings (`rgbt.runs.run_spec.settings_digest`).
    """

    seed: Count
    step: Count = 0
    best_score: float = -1.0
    best_step: Count = 0
    skipped: list[str] = field(default_factory=list)
    evaluated_step: Count = 0
    unlogged: dict[str, float] = field(default_factory=dict)
    key: str = ""
    settings: str = ""

    def skip(self, names: Iterable[str]) -> None:
        """Note files that were skipped."""
        self.skipped = sorted({*self.skipped, *names})

    @classmethod
    def of(cls, payload: Mapping[str, Any]) -> State:
        """The state in a checkpoint; TypeError if there is none."""
        text = json.dumps(payload.get("state"))
        try:
            return TypeAdapter(cls).validate_json(text, strict=True)
        except ValueError as error:
            raise TypeError(one_line(str(error))) from error


def training_payload(
    weights: dict[str, dict[str, Tensor]],
    others: dict[str, nn.Module],
    optimizers: dict[str, torch.optim.Optimizer],
    state: State,
) -> dict[str, Any]:
    """Everything a run needs to resume as if it had not stopped.

    Args:
        weights: of the network (`rgbt.engine.averaging.EvaluatedWeights.state`).
        others: further networks that are trained, by name.
        optimizers: by name.
        state: progress.
    """
    return {
        **weights,
        "others": {name: module.state_dict() for name, module in others.items()},
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
        "state": asdict(state),
    }


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The payload of a checkpoint file, tensors on the CPU.

    Raises:
        InputError: missing, damaged, or not a checkpoint of rgbt; nothing in it is executed.
    """
    payload = read_torch_file(path)
    loaded: dict[str, Any] = payload if isinstance(payload, dict) else {}
    networks = {key: loaded[key] for key in ("model", UNAVERAGED) if key in loaded}
    for group in ("others", "optimizers"):
        found = loaded.get(group, {})
        networks |= found if isinstance(found, dict) else {group: None}
    if "model" not in loaded or not all(isinstance(each, dict) for each in networks.values()):
        raise InputError(f"{path} is no checkpoint written by `rgbt run`.")
    return loaded


def check_origin(payload: Mapping[str, Any], source: Path, key: str, settings: str) -> None:
    """Refuse a checkpoint of another run, or of a configuration that was changed since.

    Args:
        payload: of the checkpoint.
        source: its file.
        key: of the run, the name of its folder.
        settings: digest of the configuration of the run.

    Raises:
        InputError: naming both runs.
    """
    stored = payload.get(NOTE, payload.get("state"))
    found = stored if isinstance(stored, dict) else {}
    if found.get("key") != key:
        raise InputError(
            f"{source} belongs to the run {found.get('key')}, not to {key}; restore the file of "
            "this run, or give its folder the name of the run."
        )
    if found.get("settings") != settings:
        raise InputError(
            f"{source.parent / 'config.yaml'} was changed after training; restore it, or train "
            "with the new settings."
        )


def step_of(payload: Mapping[str, Any], source: Path) -> int:
    """The step of a last or a best checkpoint; InputError if it does not say."""
    state = payload.get("state", payload)
    step = state.get("step") if isinstance(state, dict) else None
    if not isinstance(step, int):
        raise InputError(f"{source} does not contain its step.")
    return step


def restore_optimizer(optimizer: torch.optim.Optimizer, stored: Any, source: Path) -> None:
    """Restore the state of an optimizer, each tensor in the memory format of its parameter.

    A fused optimizer reads both in the order of memory, and a checkpoint may come from a run with
    another `trainer.memory_format`.

    Raises:
        InputError: it is the state of another optimizer.
    """
    try:
        _check_places(optimizer, stored)
        # The rate alone changes in training; how a step is computed follows from the device.
        groups = optimizer.state_dict()["param_groups"]
        for own, group in zip(groups, stored["param_groups"], strict=True):
            own["lr"] = group["lr"]
        optimizer.load_state_dict({**stored, "param_groups": groups})
    except (ValueError, TypeError, LookupError, AttributeError, RuntimeError) as error:
        raise InputError(
            f"{source} holds the state of a different optimizer than this run uses "
            f"({one_line(str(error))})."
        ) from error
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape:
                state[name] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)


def _check_places(optimizer: torch.optim.Optimizer, stored: Any) -> None:
    """Raise ValueError unless every value has the shape and type of its place.

    torch compares neither: a moment of another shape ends the next step by SIGSEGV.
    """
    groups = optimizer.state_dict()["param_groups"]
    for own, group in zip(groups, stored["param_groups"], strict=True):
        if own["params"] != group["params"] or own.keys() - group.keys():
            raise ValueError("other parameters or settings")
        for key in own.keys() - {"foreach", "fused", "capturable"}:  # of the device
            values = [each[key] for each in (own, group)]
            if _kind(values[0]) != _kind(values[1]) or (key != "lr" and values[0] != values[1]):
                raise ValueError(f"{key} is {group[key]}")
    of_state = [{name: _kind(v) for name, v in each.items()} for each in stored["state"].values()]
    if any(each != of_state[0] for each in of_state):
        raise ValueError("the states of parameters differ in kind")
    places = dict(enumerate(each for group in optimizer.param_groups for each in group["params"]))
    for index, state in stored["state"].items():
        place = places[index]
        for name, value in state.items():
            if not isinstance(value, Tensor):
                continue
            is_fit = value.ndim == 0 or (value.shape, value.dtype) == (place.shape, place.dtype)
            if not (is_plain(value) and value.is_floating_point() and is_fit):
                raise ValueError(f"{name} of parameter {index} has another shape or type")


def _kind(value: object) -> object:
    """The type of a value, of a tuple those of its parts; a whole number is a number."""
    if isinstance(value, tuple):
        return tuple(map(_kind, value))
    return float if type(value) is int else type(value)


def restore_weights(model: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Put `weights` into `model`; every name, shape and dtype must be that of its place.

    Raises:
        InputError: naming what does not fit.
    """
    found = misfits(model.state_dict(), weights)
    if found:
        raise InputError(
            f"{source} is a checkpoint of another model: {one_line('; '.join(found))}."
        )
    model.load_state_dict(weights)


class Checkpoints:
    """Read and write the checkpoints of one run folder (see the module).

    Args:
        folder: of the run.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.last = folder / "last.pt"
        self.best = folder / "best.pt"

    def commit(self, payload: dict[str, Any], state: State) -> None:
        """Write the weights if this step is the best, then the state."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if state.step == state.best_step > 0:
            origin = {"key": state.key, "settings": state.settings}
            save(self.best, {"model": payload["model"], "step": state.step, NOTE: origin})
        save(self.last, payload)

    def load(self) -> tuple[dict[str, Any], State]:
        """The payload of the last checkpoint and its state.

        Raises:
            RunError: last.pt or best.pt is missing or damaged.
        """
        with self._saying_what_to_do():
            payload = load_checkpoint(self.last)
            state = State.of(payload)
        if state.best_step:
            self.load_best(state)
        return payload, state

    def load_best(self, state: State) -> dict[str, Any]:
        """The best weights of a run, by name.

        Raises:
            RunError: the file is missing or damaged, or holds the weights of another step.
        """
        with self._saying_what_to_do():
            payload = load_checkpoint(self.best)
            check_origin(payload, self.best, state.key, state.settings)
            found = step_of(payload, self.best)
            # Weights of a later step were written just before the run was killed.
            if found != state.best_step and found <= state.step:
                raise InputError(
                    f"{self.best} is of step {found}, but the best evaluation of this run is of "
                    f"step {state.best_step}."
                )
        weights: dict[str, Any] = payload["model"]
        return weights

    @contextmanager
    def _saying_what_to_do(self) -> Iterator[None]:
        try:
            yield
        except (InputError, TypeError) as error:
            said = one_line(str(error)).rstrip(".")
            advice = "remove the folder and rerun the command to train the run from the start."
            raise RunError(f"{self.folder}: {said}; {advice}") from error


def check_weights(modules: Mapping[str, nn.Module], step: int) -> None:
    """Refuse to evaluate or save parameters and buffers that are not finite.

    Raises:
        RunError: naming the step and the first tensor with NaN or infinity.
    """
    for module in modules.values():
        broken = not_finite(module.state_dict())
        if broken:
            raise RunError(f"step {step}: '{broken[0]}' holds NaN or infinity. {ADVICE}")
