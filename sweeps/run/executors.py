"""Where the jobs of a study are executed: Hydra's group ``hydra/launcher`` decides."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from rgbt.checks import InputError
from sweeps.run.job import Work
from sweeps.run.local import LocalExecutor
from sweeps.settings import SweepSettings


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


PLACES = {
    "basic": "on this machine",
    "ray": "as tasks of Ray",
    "submitit_local": "as jobs of submitit on this machine",
    "submitit_slurm": "as jobs of SLURM",
}


def place_of(settings: SweepSettings) -> str:
    """Say where the points are executed, and how many at a time."""
    few = settings.launcher in ("basic", "submitit_local")
    number = settings.workers or (1 if few else None)
    limit = "all of them" if number is None else str(number)
    return f"{PLACES[settings.launcher]}, {limit} at a time"


def open_executor(settings: SweepSettings) -> Executor:
    """Return the executor of the launcher; InputError: its settings are wrong."""
    executor: Executor
    if settings.gpus is not None and settings.launcher != "basic":
        raise InputError(
            f"gpus={list(settings.gpus)}: hydra/launcher={settings.launcher} chooses the GPUs of a "
            "job."
        )
    if settings.launcher == "basic":
        executor = LocalExecutor(settings.workers or 1, settings.gpus)
    elif settings.launcher == "ray":
        from sweeps.run.ray_tasks import RayExecutor

        executor = RayExecutor(settings.launcher_options, settings.workers)
    else:
        from sweeps.run.submitit_jobs import SubmititExecutor

        cluster = settings.launcher.removeprefix("submitit_")
        executor = SubmititExecutor(cluster, settings.launcher_options, settings.workers)
    if not settings.wait and not executor.is_lasting:
        raise InputError("hydra.sweeper.wait=false: this Ray ends with the command.")
    return executor
