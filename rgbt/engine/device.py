"""The device of a run and the precision of its forward passes, as Lightning Fabric chooses them.

Only a training opens Fabric (`rgbt.engine.fabric`), which takes a second to import.
"""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import torch

from rgbt.checks import InputError
from rgbt.engine.settings import Precision, TrainerSettings


class Autocast(Protocol):
    """An object that knows the precision of a forward pass, such as a session."""

    def autocast(self) -> AbstractContextManager[Any]:
        """Context of a forward pass."""
        ...


def choose_device(trainer: TrainerSettings) -> torch.device:
    """The device of a run in one process; "auto" prefers a GPU.

    Raises:
        InputError: the machine has no such device.
    """
    found = {"cuda": torch.cuda.is_available(), "mps": torch.backends.mps.is_available()}
    kinds = [*(kind for kind, is_there in found.items() if is_there), "cpu"]
    kind = kinds[0] if trainer.accelerator == "auto" else trainer.accelerator
    if kind not in kinds:
        raise InputError(f"trainer.accelerator: this machine has no {kind}, only {kinds}.")
    return torch.device("cpu") if kind == "cpu" else torch.device(kind, 0)


def autocast(device: torch.device, precision: Precision) -> AbstractContextManager[Any]:
    """Context of a forward pass on a device."""
    if precision == "32-true":
        return nullcontext()
    return torch.autocast(device.type, dtype=torch.bfloat16)
