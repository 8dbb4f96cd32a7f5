"""Checkpoints: written whole or not at all, read without executing code.

Which checkpoint is taken when a run starts, first match wins:
1. ``last.pt`` of the run folder (the run continues);
2. `model.weights` (read by `rgbt.weights`);
3. fresh weights.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.checks import InputError


@dataclass
class State:
    """Where a run stands. Generators need no entry: they are derived from seed and step.

    Attributes:
        step: optimiser steps done.
        best_score: highest selection score so far, fraction; -1 before the first evaluation.
        best_step: the step it was reached at.
        seed: run seed, from which every generator is derived together with `step`.
        skipped: names of unreadable files that were left out so far, sorted.
    """

    seed: int
    step: int = 0
    best_score: float = -1.0
    best_step: int = 0
    skipped: list[str] = field(default_factory=list)

    def skip(self, names: Iterable[str]) -> None:
        """Note files that were left out."""
        self.skipped = sorted({*self.skipped, *names})


def save_checkpoint(path: Path, payload: dict[str, Any]) -> None:
    """Write `payload` to a temporary name, flush it to disk, rename it to `path`."""
    path.parent.mkdir(parents=True, exist_ok=True)
    # One name: what a killed process left half written is overwritten, never piled up.
    temporary = path.with_name(f".{path.name}.partial")
    with temporary.open("wb") as file:
        torch.save(payload, file)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)


def training_payload(
    model: nn.Module,
    others: dict[str, nn.Module],
    optimizers: dict[str, torch.optim.Optimizer],
    state: State,
) -> dict[str, Any]:
    """Everything a run needs to go on as if it had not stopped."""
    return {
        "model": model.state_dict(),
        "others": {name: module.state_dict() for name, module in others.items()},
        "optimizers": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
        "state": asdict(state),
    }


def load_checkpoint(path: Path) -> dict[str, Any]:
    """The payload of a checkpoint file, tensors on the CPU.

    Raises:
        InputError: missing, cut short, or not a checkpoint of ours.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such checkpoint.")
    try:
        payload = torch.load(path, map_location="cpu", weights_only=True)
    except (RuntimeError, EOFError, pickle.UnpicklingError, KeyError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"{path} cannot be read as a checkpoint ({reason}).") from error
    if not isinstance(payload, dict) or "model" not in payload:
        raise InputError(
            f"{path} holds no weights under 'model'; give a checkpoint written by rgbt.run."
        )
    return payload


def restore_weights(model: nn.Module, weights: dict[str, Tensor], source: Path) -> None:
    """Put `weights` into `model`; every key must fit.

    Raises:
        InputError: naming missing, unexpected and differently shaped keys.
    """
    own = model.state_dict()
    missing = sorted(own.keys() - weights.keys())
    unexpected = sorted(weights.keys() - own.keys())
    reshaped = sorted(k for k in own.keys() & weights.keys() if own[k].shape != weights[k].shape)
    if missing or unexpected or reshaped:
        raise InputError(
            f"{source} is a checkpoint of another model: {_some('missing', missing)}, "
            f"{_some('unexpected', unexpected)}, {_some('of another shape', reshaped)}; "
            "use the model it was trained with (model=... in its config.yaml)."
        )
    model.load_state_dict(weights)


def _some(what: str, keys: list[str]) -> str:
    shown = ", ".join(keys[:2])
    return f"{len(keys)} keys {what}" + (
        f" ({shown}{', ...' if len(keys) > 2 else ''})" if keys else ""
    )
