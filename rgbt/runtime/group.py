"""The processes that train one run, as torchrun or srun describe them; without torch.

``rgbt run`` with several devices starts them by torchrun itself (`rgbt.training.pipeline`). Process
0 prints and writes; what the others print is dropped.
"""

from __future__ import annotations

import ctypes
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout, suppress
from pathlib import Path
from typing import NamedTuple

PR_SET_PDEATHSIG = 1


class Group(NamedTuple):
    """Number of this process and of all, and of those on each machine."""

    rank: int
    size: int
    local_size: int


def group_from_environment() -> Group | None:
    """Read the group of this process; None if it trains alone.

    SLURM_NTASKS is set in a batch script too, where one process runs and srun was not used.
    """
    found = os.environ
    if "TORCHELASTIC_RUN_ID" in found:
        group = Group(*(int(found[n]) for n in ("RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE")))
    else:
        size = int(found.get("SLURM_STEP_NUM_TASKS", "1"))
        local_size = size // int(found.get("SLURM_STEP_NUM_NODES", "1"))
        group = Group(int(found.get("SLURM_PROCID", "0")), size, local_size)
    return group if group.size > 1 else None


def end_with_parent(number: signal.Signals) -> None:
    """Get this signal when the process that started this one ends (Linux; elsewhere nothing)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, number)


@contextmanager
def taking_part() -> Iterator[None]:
    """Begin a command that may be one of several processes of a run; see the module."""
    group = group_from_environment()
    if group is not None and "TORCHELASTIC_RUN_ID" in os.environ:
        end_with_parent(signal.SIGKILL)  # with torchrun, also if that is killed
    if group is None or group.rank == 0:
        yield
        return
    with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere), redirect_stderr(nowhere):
        yield
