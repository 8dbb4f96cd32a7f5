"""Say which settings need less memory where a device has none left."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager

import torch

from rgbt.checks import InputError, RunError
from rgbt.engine.device import MODES
from rgbt.engine.settings import TrainerSettings
from rgbt.processes import num_processes
from rgbt.requirements import NetworkRecord

# Of the allocators of CUDA, cuDNN and MPS, and of torch on the CPU.
NO_MEMORY = re.compile("out of memory|_ALLOC_FAILED|can't allocate memory|not enough memory")


@contextmanager
def naming_memory(device: torch.device, what: str, advice: str) -> Iterator[None]:
    """Turn an error of a device without memory for `what`, "a step", into an InputError."""
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, RunError) or not NO_MEMORY.search(str(error)):
            raise
        found = ""
        if device.type == "cuda":
            peak = torch.cuda.max_memory_allocated(device) / 2**30
            free, size = torch.cuda.mem_get_info(device)
            rest = f"{free / 2**30:.1f} of {size / 2**30:.1f} free"
            found = f" (GiB: {peak:.1f} used at most, {rest})"
        raise InputError(f"{device} is out of memory in {what}{found}. {advice}") from error


def training_advice(
    trainer: TrainerSettings, batch_size: int, network: NetworkRecord, crop_hw: object
) -> str:
    """Name settings with which a training needs less: to resume it, and for a new run."""
    same, other = [], []
    is_whole = trainer.compile in MODES
    if network.recomputed and not is_whole and not trainer.activation_checkpointing:
        same.append("trainer.activation_checkpointing=true")
    share = batch_size // num_processes()
    parts = next((number for number in range(2, share + 1) if share % number == 0), None)
    if parts is None:
        other.append("a smaller transform.crop_hw" if crop_hw else "smaller images")
    else:
        same.append("more trainer.devices")
        accumulated = f"trainer.accumulate={trainer.accumulate * parts}"
        other.append(f"data.batch_size={batch_size // parts} {accumulated}")
        other += ["a smaller transform.crop_hw"] if crop_hw else []
    if trainer.precision == "32-true":
        other.append("trainer.precision=bf16-mixed")
    resumes = f"To resume it with less, set {' or '.join(same)}. " if same else ""
    return f"{resumes}A new run needs less with {' or '.join(other)}."
