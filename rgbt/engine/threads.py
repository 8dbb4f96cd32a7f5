"""Set the number of CPU threads, which is a setting of the run and not of the machine."""

from __future__ import annotations

import os

import torch

from rgbt.checks import InputError


def fix_threads(num_threads: int) -> None:
    """Compute with this number of threads, independently of the number of cores.

    Sums are divided among the threads, and other parts round to other bits. OMP_NUM_THREADS,
    MKL_NUM_THREADS, MKL_DYNAMIC and a smaller set of cores (taskset, a cluster's job) have no
    effect after this call.

    Args:
        num_threads: >= 1.

    Raises:
        InputError: the environment lets OpenMP take fewer threads: torch then waits for ever for
            the others (seen with torch 2.13).
    """
    limit = os.environ.get("OMP_THREAD_LIMIT", "")
    is_limited = limit.isdecimal() and int(limit) < num_threads
    if is_limited or os.environ.get("OMP_DYNAMIC", "").strip().lower() == "true":
        name = "OMP_THREAD_LIMIT" if is_limited else "OMP_DYNAMIC"
        raise InputError(
            f"{name}={os.environ[name]} limits OpenMP to fewer threads than "
            f"trainer.threads={num_threads}, and the result depends on the number of threads. "
            f"Unset {name}."
        )
    torch.set_num_threads(num_threads)
