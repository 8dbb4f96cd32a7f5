"""What a run saves: the weights that are evaluated, the state to resume from, and their files.

A run starts from ``last.pt`` of its folder, else from `model.weights`, else from random weights.
The weights and counts of the best evaluation are written to a folder of their own, then the
``last.pt`` that names their step; then they get their names. So the files that ``last.pt`` names
are there whenever the process is killed (`settle`), and no others.
"""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any

import torch
from annotated_types import Ge
from pydantic import TypeAdapter
from torch import Tensor, nn

from rgbt.averaging import AveragedNetwork
from rgbt.checkpoints.files import NOTE, is_plain, misfits, read_torch_file, save
from rgbt.checks import InputError, RunError, not_finite, one_line
from rgbt.engine.settings import TrainerSettings
from rgbt.files.plain_files import check_links, inside
from rgbt.processes import computed_once

LAST, BEST = "last.pt", "best.pt"  # names in the run folder
NEXT = "next_"  # begins the name of a folder of files that last.pt may not name yet; their step
UNAVERAGED = "unaveraged"  # weights of the last step, where "model" has averaged ones
WARM_UP = 9  # the decay of step n is at most n / (n + 9), as in TensorFlow's moving average
CHANGING = {"lr", "foreach", "fused", "capturable"}  # set before every step, or by the device
Count = Annotated[int, Ge(0)]
ADVICE = "Lower optimizer.lr, or set trainer.precision=32-true; the last checkpoint is kept."

# The content of ``best.pt``, and what writes the other files of its evaluation into a folder.
Best = tuple[dict[str, Any], Callable[[Path], None]]


class EvaluatedWeights:
    """Holds the weights of a network that are evaluated: its own, or their average in a copy.

    Source: "ema" is the teacher of Tarvainen and Valpola (2017); "last" is stochastic weight
    averaging of Izmailov et al. (2018), but statistics of batch normalisation are averaged, not
    estimated again on the training images.
    """

    def __init__(self, model: nn.Module, settings: TrainerSettings) -> None:
        self._model, self._settings = model, settings
        is_averaged = settings.averaging != "none"
        self._average = AveragedNetwork(model, buffers=True) if is_averaged else None
        self._is_begun = settings.averaging == "ema"

    def update(self, step: int) -> None:
        """Add the weights after `step` optimizer steps, >= 1; called after every step."""
        settings = self._settings
        if settings.averaging == "ema":
            share = 1 - min(settings.ema_decay, step / (step + WARM_UP))
        else:
            averaged = max(1, round(settings.averaged_share * settings.max_steps))
            number = step - (settings.max_steps - averaged)
            share = 1 / number if number > 0 else 0.0
        if self._average is not None and share:
            self._average.update(self._model, share)
            self._is_begun = True

    @property
    def network(self) -> nn.Module:
        """Return the network to evaluate: the average, or the trained one before it begins."""
        average = self._average if self._is_begun else None
        return self._model if average is None else average.module

    def state(self) -> dict[str, dict[str, Tensor]]:
        """Return weights to evaluate ("model"), and to resume from where these are others."""
        own = {} if self.network is self._model else {UNAVERAGED: self._model.state_dict()}
        return {"model": self.network.state_dict(), **own}

    def restore(self, payload: Mapping[str, dict[str, Tensor]], source: Path) -> None:
        """Restore the network and its average from a checkpoint; InputError: of another network."""
        self._is_begun = UNAVERAGED in payload
        restore_weights(self.network, payload["model"], source)
        if self._is_begun:
            restore_weights(self._model, payload[UNAVERAGED], source)


@dataclass
class State:
    """Holds the progress of a run. Generators need no entry: they follow from seed and step.

    `evaluated_step` is that of the last evaluation: a signal may have come before that of `step`.
    `unlogged` are values since the last line of ``metrics.jsonl``. `key` and `settings` (a digest,
    `rgbt.runs.run_spec.settings_digest`) say which run it is.
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
        """Return the state in a checkpoint; TypeError: none."""
        try:
            text = json.dumps(payload.get("state"))
            return TypeAdapter(cls).validate_json(text, strict=True)
        except ValueError as error:
            raise TypeError(one_line(error)) from error


def training_payload(
    weights: dict[str, dict[str, Tensor]],
    others: dict[str, nn.Module],
    optimizers: dict[str, torch.optim.Optimizer],
    state: State,
) -> dict[str, Any]:
    """Gather what a run needs to resume; `weights` are those of `EvaluatedWeights.state`."""
    return {
        **weights,
        "others": {name: module.state_dict() for name, module in others.items()},
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
        "state": asdict(state),
    }


def load_checkpoint(path: Path) -> dict[str, Any]:
    """Load the payload of a checkpoint of rgbt, tensors on the CPU; InputError: it is none."""
    payload = read_torch_file(path)
    loaded: dict[str, Any] = payload if isinstance(payload, dict) else {}
    parts = [loaded.get("model"), loaded.get(UNAVERAGED, {})]
    for key in ("others", "optimizers"):
        group = loaded.get(key, {})
        parts.append(group)
        if isinstance(group, dict):
            parts += group.values()
    if not all(isinstance(part, dict) for part in parts):
        raise InputError(f"{path} is no checkpoint written by `rgbt run`.")
    return loaded


def check_origin(payload: Mapping[str, Any], source: Path, key: str, settings: str) -> None:
    """Refuse a checkpoint of another run or of changed settings (a digest), by InputError."""
    stored = payload.get(NOTE, payload.get("state"))
    found = stored if isinstance(stored, dict) else {}
    if found.get("key") != key:
        raise InputError(f"{source} belongs to the run {found.get('key')}, not to {key}.")
    if found.get("settings") != settings:
        raise InputError(f"{source.parent / 'config.yaml'} was changed after training; restore it.")


def step_of(payload: Mapping[str, Any], source: Path) -> int:
    """Return the step of a last or a best checkpoint; InputError if it does not say."""
    state = payload.get("state", payload)
    step = state.get("step") if isinstance(state, dict) else None
    if not isinstance(step, int):
        raise InputError(f"{source} does not contain its step.")
    return step


def restore_weights(model: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Put `weights` into `model`; InputError names what has not the shape and type of its place."""
    found = misfits(model.state_dict(), weights)
    if found:
        said = one_line("; ".join(found))
        raise InputError(f"{source} is a checkpoint of another model: {said}.")
    model.load_state_dict(weights)


def restore_optimizer(optimizer: torch.optim.Optimizer, stored: Any, source: Path) -> None:
    """Restore the state of an optimizer; InputError: it is that of another one."""
    try:
        groups = optimizer.state_dict()["param_groups"]
        _check_settings(groups, stored["param_groups"])
        _check_states(optimizer, stored["state"])
        optimizer.load_state_dict({**stored, "param_groups": groups})
    except (ValueError, TypeError, LookupError, AttributeError, RuntimeError) as error:
        said = f"{source} holds the state of a different optimizer than that of this run"
        raise InputError(f"{said} ({one_line(error)}).") from error
    # A fused optimizer reads parameters and moments in the order of memory, and a checkpoint may
    # come from a run with another trainer.memory_format.
    for parameter, state in optimizer.state.items():
        for name, value in state.items():
            if isinstance(value, Tensor) and value.shape == parameter.shape:
                state[name] = torch.empty_like(parameter, dtype=value.dtype).copy_(value)


def _check_settings(groups: Any, stored: Any) -> None:
    """Raise an error for stored groups of parameters with other settings than `groups`."""
    for own, group in zip(groups, stored, strict=True):
        for key in own.keys() - CHANGING:
            if own[key] != group[key]:
                raise ValueError(f"{key} is {group[key]}")


def _check_states(optimizer: torch.optim.Optimizer, stored: Any) -> None:
    """Raise an error for stored states at whose step torch would end by SIGSEGV."""
    parameters: list[nn.Parameter] = []
    for group in optimizer.param_groups:
        parameters += group["params"]
    places = dict(enumerate(parameters))
    kinds: dict[str, type] | None = None
    for index, state in stored.items():
        found = {name: type(value) for name, value in state.items()}
        if kinds is None:
            kinds = found
        if found != kinds:
            raise ValueError("the states of parameters differ in kind")
        place = places[index]
        for name, value in state.items():
            if not isinstance(value, Tensor):
                continue
            is_fit = value.ndim == 0 or (value.shape, value.dtype) == (place.shape, place.dtype)
            if not (is_fit and is_plain(value) and value.is_floating_point()):
                raise ValueError(f"{name} of parameter {index} has another shape or type")


def best_payload(weights: dict[str, Tensor], state: State) -> dict[str, Any]:
    """Gather what ``best.pt`` holds, of the evaluation of this step."""
    origin = {"key": state.key, "settings": state.settings}
    return {"model": weights, "step": state.step, NOTE: origin}


def commit(folder: Path, payload: dict[str, Any], best: Best | None) -> None:
    """Write the state, and the files of the evaluation that it names if they are not there yet.

    RunError: weights are not finite; OSError: as `save`. Then the files are as they were.
    """
    step = payload["state"]["step"]
    for weights in (payload["model"], payload.get(UNAVERAGED, {}), *payload["others"].values()):
        check_finite(weights, step)
    folder.mkdir(parents=True, exist_ok=True)
    if best is not None:
        settle(folder, 0)
        coming = folder / f"{NEXT}{payload['state']['best_step']}"
        coming.mkdir()
        weights, write_files = best
        write_files(coming)
        save(coming / BEST, weights)
    save(folder / LAST, payload)
    settle(folder, payload["state"]["best_step"])


def settle(folder: Path, best_step: int) -> None:
    """Name the files that were written for ``last.pt`` with this best step, and remove others.

    InputError: one of them is a link that leads out of the folder.
    """
    for coming in folder.glob(f"{NEXT}*"):
        check_links(inside(coming, folder))
        if coming.name == f"{NEXT}{best_step}":
            for file in filter(Path.is_file, coming.rglob("*")):
                target = folder / file.relative_to(coming)
                target.parent.mkdir(exist_ok=True)
                file.replace(target)
        shutil.rmtree(coming)


def check_finite(weights: Mapping[str, Tensor], step: int) -> None:
    """Refuse to evaluate or save parameters and buffers that are not finite, by RunError."""
    for name in not_finite(weights):
        raise RunError(f"step {step}: '{name}' holds NaN or infinity. {ADVICE}")


def load_last(folder: Path) -> tuple[dict[str, Any], State]:
    """Load the last checkpoint of a run folder and its state; RunError: a file is unusable.

    Process 0 names what a killed process left (`settle`).
    """
    with _saying_what_to_do(folder):
        payload = load_checkpoint(folder / LAST)
        state = State.of(payload)
    computed_once(lambda: settle(folder, state.best_step))
    if state.best_step:
        load_best(folder, state)
    return payload, state


def load_best(folder: Path, state: State) -> dict[str, Any]:
    """Load the best weights of a run; RunError: the file is unusable or of another step."""
    best = folder / BEST
    with _saying_what_to_do(folder):
        payload = load_checkpoint(best)
        check_origin(payload, best, state.key, state.settings)
        found = step_of(payload, best)
        if found != state.best_step:
            raise InputError(f"{best} is of step {found}, not of {state.best_step}")
    return dict(payload["model"])


@contextmanager
def _saying_what_to_do(folder: Path) -> Iterator[None]:
    try:
        yield
    except (InputError, TypeError) as error:
        advice = "remove the folder and rerun the command to train the run from the start."
        raise RunError(f"{folder}: {one_line(error)}; {advice}") from error
