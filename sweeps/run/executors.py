"""Where the jobs of a study are executed: Hydra's group ``hydra/launcher`` decides."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from importlib.util import find_spec
from typing import Protocol

from rgbt.checks import InputError
from rgbt.config.overrides import LAUNCHERS
from sweeps.run.job import Work
from sweeps.run.local import LocalExecutor
from sweeps.settings import GpuSlot, Launcher

WORKING = ("basic", "submitit_local", "submitit_slurm", "ray")


class Executor(Protocol):
    """Executes points. A job is its name, which another driver of the study understands too."""

    slots: int  # jobs at the same time, queued ones included
    is_lasting: bool  # whether jobs continue without the driver

    def submit(self, works: Sequence[Work]) -> list[str]:
        """Start or queue jobs; a point that has one already keeps it. RunError: not possible."""

    def state(self, job: str) -> str:
        """Return "queued", "running", or how it ended ("ended": see its log and the run folder)."""

    def cancel(self, job: str) -> None:
        """Remove a job that is queued; let one that runs save its step and end."""


def check_launcher(launcher: Launcher) -> None:
    """InputError: a launcher with which a sweep does not work, or its packages are missing."""
    name = launcher.name
    if name not in WORKING:
        hint = f" ({LAUNCHERS[name]})" if name in LAUNCHERS else ""
        raise InputError(f"hydra/launcher={name}: a sweep works with {', '.join(WORKING)}{hint}.")
    if name == "ray" and find_spec("ray") is None:
        raise InputError("hydra/launcher=ray: it needs pip install 'rgbt[ray]'.")


def open_executor(
    launcher: Launcher, workers: int | None, gpus: Sequence[GpuSlot] | None
) -> Executor:
    """The executor of a launcher with at most `workers` jobs; InputError as of its settings."""
    check_launcher(launcher)
    if gpus is not None and launcher.name != "basic":
        raise InputError(f"gpus={gpus}: hydra/launcher={launcher.name} chooses the GPUs of a job.")
    if launcher.name == "basic":
        return LocalExecutor(workers or 1, gpus)
    if launcher.name == "ray":
        from sweeps.run.ray_tasks import RayExecutor

        return RayExecutor(launcher.options, workers or sys.maxsize)
    from sweeps.run.submitit_jobs import SubmititExecutor

    cluster = launcher.name.removeprefix("submitit_")
    return SubmititExecutor(cluster, launcher.options, workers)
