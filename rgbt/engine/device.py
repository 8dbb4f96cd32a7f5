"""Device, precision, threads and memory allocator of a command.

Only a training opens Lightning Fabric (`rgbt.engine.fabric`), which takes a second to import.
"""

from __future__ import annotations

import ctypes
import os
import platform
from contextlib import AbstractContextManager, nullcontext
from typing import Any, Protocol

import torch

from rgbt.checks import InputError
from rgbt.engine.settings import Precision, TrainerSettings

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3


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


def fix_threads(num_threads: int) -> None:
    """Compute with this number of threads, >= 1, independently of the number of cores.

    Sums are divided among the threads, and other parts round to other bits. OMP_NUM_THREADS,
    MKL_NUM_THREADS, MKL_DYNAMIC and a smaller set of cores (taskset, a cluster's job) have no
    effect after this call.

    Raises:
        InputError: the environment lets OpenMP take fewer threads: torch then waits for ever for
            the others (seen with torch 2.13).
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    is_limited = limit.isdecimal() and int(limit) < num_threads
    if is_limited or os.environ.get("OMP_DYNAMIC", "").strip().lower() == "true":
        name = "OMP_THREAD_LIMIT" if is_limited else "OMP_DYNAMIC"
        raise InputError(
            f"trainer.threads={num_threads}: the environment variable {name}={os.environ[name]} "
            "limits OpenMP to fewer threads; unset it."
        )
    torch.set_num_threads(num_threads)


def keep_memory() -> None:
    """Tell glibc to keep freed tensors instead of giving their pages back to the kernel.

    By default every large tensor is unmapped when freed and page-faulted in again when the next
    one is made: adding 1 to a 40 MB tensor took 28.5 ms, and 6 ms with this setting. The price is
    up to 30 % more resident memory. Must run before torch allocates.
    """
    if platform.libc_ver()[0] != "glibc":
        return
    libc = ctypes.CDLL("libc.so.6")
    # Both are needed: the first stops single large blocks from being mapped one by one, the
    # second stops the heap from being trimmed.
    libc.mallopt(M_MMAP_THRESHOLD, 1 << 30)
    libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
