"""Jobs as tasks of Ray, which chooses their nodes and GPUs, fractions of a GPU included.

The tasks belong to an actor that outlives the command, so that a driver may end or be killed while
they run. Ray repeats the task of a lost node on another one, where its run resumes.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import ray
from annotated_types import Interval

from rgbt.checks import InputError, RunError, check_choice, one_line
from rgbt.config.values import check_value
from rgbt.terminal import info
from sweeps.run.job import Job, Work

KEEPER, NAMESPACE = "jobs", "rgbt"


# Settings of ``conf/hydra/launcher/ray.yaml``, which explains them.
OPTIONS: dict[str, Any] = {
    "address": str | None,
    "num_gpus": Annotated[float, Interval(ge=0, le=64)] | None,
    "num_cpus": Annotated[float, Interval(gt=0, le=1024)],
    "max_retries": Annotated[int, Interval(ge=-1, le=1000)],
}


class Keeper:
    """Submits tasks and knows their states, as an actor; a job is named by the log of its point.

    Ray ends the tasks of a process with that process, so that a driver cannot own them itself.
    """

    def __init__(self) -> None:
        self._tasks: dict[str, Any] = {}
        self._begins: dict[str, int] = {}  # sizes of logs before, which grow when a task begins
        self._ends: dict[str, str] = {}

    def submit(self, job: str, work: Work, resources: Mapping[str, Any], begin: int) -> int:
        """Queue a job, unless it is; return the size of its log, `begin`, when it was queued."""
        if self.state(job) != "running":
            self._ends.pop(job, None)
            self._begins[job] = begin
            self._tasks[job] = ray.remote(_execute).options(**resources).remote(work)
        return self._begins[job]

    def state(self, job: str) -> str:
        """See `Executor.state`; a task that waits for resources is "running", too."""
        if job not in self._tasks:
            return self._ends.get(job, "ended")
        if not ray.wait([self._tasks[job]], timeout=0)[0]:
            return "running"
        try:
            ray.get(self._tasks.pop(job))
            self._ends[job] = "ended"
        except Exception as error:  # any error of a task, of its node, or of Ray
            self._ends[job] = f"lost by Ray: {one_line(error)}"
        return self._ends[job]

    def cancel(self, job: str) -> None:
        """See `Executor.cancel`."""
        if job in self._tasks:
            ray.cancel(self._tasks[job])


class RayExecutor:
    """Executes jobs on the Ray cluster at `address`, on one that runs here, or on a new one."""

    def __init__(self, options: Mapping[str, Any], workers: int | None) -> None:
        for name, value in options.items():
            check_choice("hydra.launcher", name, OPTIONS)
            check_value(f"hydra.launcher.{name}", value, OPTIONS[name])
        self.slots, self.is_lasting = workers or sys.maxsize, _connect(options["address"])
        self._resources = {name: value for name, value in options.items() if name != "address"}
        if options["num_gpus"] is None:
            self._resources["num_gpus"] = 1.0 if ray.cluster_resources().get("GPU") else 0.0
        self._warn_if_too_large()
        # On the head node: with the loss of that one, the cluster ends anyway.
        head = {"num_cpus": 0, "resources": {"node:__internal_head__": 0.001}}
        kept = {"name": KEEPER, "get_if_exists": True, "lifetime": "detached", **head}
        self._keeper = ray.remote(Keeper).options(**kept).remote()
        self._begins: dict[str, int] = {}

    def submit(self, works: Sequence[Work]) -> list[str]:
        """See `Executor.submit`."""
        jobs = [str(work.log) for work in works]
        for job, work in zip(jobs, works, strict=True):
            self._begins[job] = self._ask("submit", job, work, self._resources, _size(job))
        return jobs

    def state(self, job: str) -> str:
        """See `Executor.state`."""
        state = str(self._ask("state", job))
        return "queued" if state == "running" and _size(job) <= self._begins[job] else state

    def cancel(self, job: str) -> None:
        """See `Executor.cancel`."""
        self._ask("cancel", job)

    def _ask(self, name: str, *arguments: Any) -> Any:
        try:
            return ray.get(getattr(self._keeper, name).remote(*arguments))
        except ray.exceptions.RayError as error:
            raise RunError(f"Ray cannot be reached any more: {one_line(error)}") from error

    def _warn_if_too_large(self) -> None:
        wanted = {"GPU": self._resources["num_gpus"], "CPU": self._resources["num_cpus"]}
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        for node in nodes:
            if all(node.get(name, 0) >= size for name, size in wanted.items()):
                return
        info(f"no node of the Ray cluster has {wanted}: runs wait until there is one.")


def _connect(address: str | None) -> bool:
    """Connect to Ray, and start it if none runs or is named; whether it continues without us."""
    answer = signal.getsignal(signal.SIGTERM)
    try:
        return _init(address)
    finally:  # Ray's own answer prints a stack of C++, and its exit code is 15
        signal.signal(signal.SIGTERM, answer)


def _init(address: str | None) -> bool:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")  # nothing is sent anywhere
    quiet: dict[str, Any] = {"namespace": NAMESPACE, "log_to_driver": False, "logging_level": 30}
    try:
        ray.init(address or "auto", **quiet)
    except (ConnectionError, ValueError, RuntimeError) as error:
        if address is not None or not isinstance(error, ConnectionError):
            reason = f"hydra.launcher.address={address}: {one_line(error)}"
            raise InputError(reason) from error
        ray.init(include_dashboard=False, **quiet)
        return False
    return True


def _size(log: str) -> int:
    return Path(log).stat().st_size if Path(log).exists() else 0


def _execute(work: Work) -> int:
    return Job(work)()
