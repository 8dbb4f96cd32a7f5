"""The processes that train one run, as the environment describes them; without torch.

`rgbt run` with several devices starts them itself (`rgbt.training.launcher`), with the variables
that torchrun uses. Under `torchrun` and `srun` they are there already.
"""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from rgbt.checks import InputError

SUPERVISOR = "RGBT_SUPERVISOR"
"""Variable with the number of the process that started this one as one of several."""

OF_TORCHRUN = ("RANK", "WORLD_SIZE", "LOCAL_RANK", "LOCAL_WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT")

FIRST_PORT, NUM_PORTS = 15_000, 15_000
"""Ports from which a job of SLURM takes one, if MASTER_PORT is not set."""


@dataclass(frozen=True)
class Group:
    """The number of this process among all that train the run, and where these meet.

    Attributes:
        rank: number of this process, 0..size-1.
        size: number of processes, >= 2.
        local_rank: number of this process on its machine, 0..local_size-1.
        local_size: number of processes on each machine.
        address: of the machine of process 0.
        port: on which process 0 listens.
        started_by: command that started the processes.
    """

    rank: int
    size: int
    local_rank: int
    local_size: int
    address: str
    port: int
    started_by: Literal["rgbt", "torchrun", "srun"]

    @property
    def is_supervised(self) -> bool:
        """Whether a process of rgbt started this one, and reports its errors."""
        return self.started_by == "rgbt"

    @cached_property
    def title(self) -> str:
        """Number of this process for messages: "process 1 of 2"."""
        return f"process {self.rank} of {self.size}"


def group_from_environment(environment: Mapping[str, str] = os.environ) -> Group | None:
    """The group of this process; None if it trains by itself.

    Raises:
        InputError: variables that contradict each other.
    """
    group = _of_torchrun(environment) or _of_slurm(environment)
    if group is None or group.size == 1:
        return None
    if group.size % group.local_size or not 0 <= group.rank < group.size:
        raise InputError(
            f"{group.started_by} started {group.size} processes, with {group.local_size} on this "
            "machine; expected the same number on every machine."
        )
    return group


def _of_torchrun(environment: Mapping[str, str]) -> Group | None:
    if not all(environment.get(name) for name in OF_TORCHRUN):
        return None
    rank, size, local_rank, local_size = (_number(environment, each) for each in OF_TORCHRUN[:4])
    return Group(
        *(rank, size, local_rank, local_size),
        address=environment["MASTER_ADDR"],
        port=_number(environment, "MASTER_PORT"),
        started_by="rgbt" if environment.get(SUPERVISOR) else "torchrun",
    )


def _of_slurm(environment: Mapping[str, str]) -> Group | None:
    # SLURM_NTASKS is set in a batch script too, where one process runs and srun was not used.
    if environment.get("SLURM_STEP_NUM_TASKS", "1") == "1":
        return None
    sizes = _tasks_of_machines(environment.get("SLURM_STEP_TASKS_PER_NODE", ""))
    size = _number(environment, "SLURM_STEP_NUM_TASKS")
    if len(set(sizes)) != 1 or sum(sizes) != size:
        raise InputError(
            f"srun started {size} processes, on the machines of the job "
            f"{'+'.join(map(str, sizes)) or 'an unknown number'}; expected the same number on "
            "every machine. Set --ntasks-per-node."
        )
    job, step = (int(environment.get(name) or 0) for name in ("SLURM_JOB_ID", "SLURM_STEP_ID"))
    nodes = environment.get("SLURM_STEP_NODELIST") or environment.get("SLURM_NODELIST", "")
    return Group(
        rank=_number(environment, "SLURM_PROCID"),
        size=size,
        local_rank=_number(environment, "SLURM_LOCALID"),
        local_size=sizes[0],
        address=environment.get("MASTER_ADDR") or first_host(nodes),
        # Two steps of one job, or two jobs on one machine, need two ports.
        port=int(environment.get("MASTER_PORT") or FIRST_PORT + (10 * job + step) % NUM_PORTS),
        started_by="srun",
    )


def _number(environment: Mapping[str, str], name: str) -> int:
    text = environment.get(name, "")
    if not text.isdecimal():
        raise InputError(
            f"the environment variable {name} is '{text}', but a process among several needs its "
            "number there. Start the command with torchrun or srun, or unset the variable."
        )
    return int(text)


def _tasks_of_machines(text: str) -> list[int]:
    """Numbers of tasks by machine as SLURM writes them: "2(x3),1" -> [2, 2, 2, 1]."""
    found = re.findall(r"(\d+)(?:\(x(\d+)\))?", text)
    return [int(number) for number, times in found for _ in range(int(times or 1))]


def first_host(nodes: str) -> str:
    """The first name in a list of machines of SLURM.

    Examples:
        >>> first_host("gpu[07-09,12],cpu1"), first_host("a1,a2")
        ('gpu07', 'a1')
    """
    found = re.match(r"([^\[,]*)(?:\[([^\],-]+)[^\]]*\])?([^\[,]*)", nodes)
    return "".join(part or "" for part in found.groups()) if found else ""
