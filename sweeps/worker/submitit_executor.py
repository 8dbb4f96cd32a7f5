"""Runs as jobs of a cluster: ``executor=submitit``, one submitit job per run.

The driver stays where it was started (a login node, inside tmux). What it submits is the plain
command, which continues its own run folder: a job that SLURM preempts and requeues resumes from its
checkpoint, and so does one that reaches its time limit, at most ``max_num_timeout`` times.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import submitit
from submitit.core.utils import FailedJobError, FailedSubmissionError

from rgbt.checks import InputError
from sweeps.worker.processes import GPUS, Job

QUIET = 'trap "" USR2; exec "$0" "$@"'
"""SLURM sends submitit's signal to all processes of a job: it is for submitit's alone."""
YEAR_MIN = 365 * 24 * 60  # Time limit of a local job: submitit's own is two minutes
KILL_S = 600.0  # How long a preempted job waits for SLURM to end it
ASK_S = 5.0  # Seconds between two queries of a job that has to stop
FAILED = 1  # Exit code of a job that ended without one; its log holds the reason


@dataclass(frozen=True)
class Command(submitit.helpers.Checkpointable):  # type: ignore[misc]
    """Runs ``python -m <words>`` inside a job; queued again, it is the same command."""

    words: tuple[str, ...]
    environment: Mapping[str, str]
    log: str

    def __call__(self) -> int:
        """The exit code, negative for a signal."""
        with Path(self.log).open("ab") as log:
            process = subprocess.Popen(
                ["bash", "-c", QUIET, sys.executable, "-m", *self.words],
                env={**os.environ, **self.environment},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )
        try:
            code = process.wait()
        finally:
            process.terminate()  # an exception is Ctrl-C, or submitit that queues the job again
        is_terminated = code in (-signal.SIGTERM, 128 + signal.SIGTERM)
        if is_terminated and os.environ.get("SUBMITIT_EXECUTOR") == "slurm":
            # SLURM takes the node away: a job that ends before it is ended is not queued again.
            time.sleep(KILL_S)
        return code


class SubmititExecutor:
    """Starts every run as a job; see `sweeps.worker.processes.Executor`.

    Args:
        folder: of what submitit writes; for SLURM on a disk that the nodes share.
        options: ``cluster`` ("slurm", "local": processes of this machine, "debug": inside the
            driver) and submitit's parameters, with or without ``slurm_`` in front.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        values = {"name": "rgbt", **options}
        self._cluster = str(values.pop("cluster", "slurm"))
        if self._cluster == "slurm" and "timeout_min" not in values:
            raise InputError("submitit.timeout_min has no value: minutes of a job, see `sinfo`.")
        if "cpus_per_task" in values:
            # From SLURM 22.05 on, a step does not take over the cores of its job by itself.
            values["srun_args"] = [f"--cpus-per-task={values['cpus_per_task']}"]
        if self._cluster == "local":
            values.setdefault("timeout_min", YEAR_MIN)
        shared, prefix = submitit.AutoExecutor._valid_parameters(), f"{self._cluster}_"
        named = {
            key if key in shared or key.startswith(prefix) else prefix + key: value
            for key, value in values.items()
        }
        limit = {key: named.pop(key) for key in (f"{prefix}max_num_timeout",) if key in named}
        place = folder.resolve() / "%j"
        try:
            self._executor = submitit.AutoExecutor(place, cluster=self._cluster, **limit)
            self._executor.update_parameters(**named)
        except (AssertionError, NameError, RuntimeError, TypeError, ValueError) as error:
            raise InputError(f"submitit: {str(error).splitlines()[0]}") from error

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Job:
        """See `Executor.start`; a job that the cluster refuses fails with the reason."""
        log.parent.mkdir(parents=True, exist_ok=True)
        wanted = dict(environment)
        if self._cluster == "slurm" and GPUS in wanted:
            raise InputError("gpus: the cluster assigns them; set submitit.gpus_per_node=1.")
        if self._cluster == "local" and GPUS in os.environ:
            wanted.setdefault(GPUS, os.environ[GPUS])  # submitit hides all GPUs from a local job
        try:
            job = self._executor.submit(Command(tuple(command), wanted, str(log.resolve())))
        except (FailedJobError, FailedSubmissionError, OSError) as error:
            _note(log, f"the job was not accepted: {str(error).strip().splitlines()[0]}")
            job = None
        return SubmititJob(job, log)


class SubmititJob:
    """A job of the cluster, None for a refused one; see `sweeps.worker.processes.Job`."""

    def __init__(self, job: submitit.Job[int] | None, log: Path) -> None:
        self._job, self._log = job, log
        self._code = FAILED if job is None else None
        self._ask_at: float | None = None

    def poll(self) -> int | None:
        """See `Job.poll`; submitit asks SLURM every ten minutes for a job without a result."""
        if self._code is not None or self._job is None:
            return self._code
        is_asked = self._ask_at is not None and time.monotonic() > self._ask_at
        if is_asked:
            self._ask_at = time.monotonic() + ASK_S
        if not self._job.done(force_check=is_asked):
            return None
        if self._ask_at is not None and not self._job.paths.result_pickle.exists():
            self._code = -signal.SIGTERM
        elif (error := self._job.exception()) is None:
            self._code = self._job.result()
        else:
            lines = [line for line in str(error).splitlines() if line.strip("- ")]
            _note(self._log, f"job {self._job.job_id} ended: {' '.join(lines[:2])[:280]}")
            self._code = FAILED
        return self._code

    def stop(self) -> None:
        """See `Job.stop`; a job that waits in the queue leaves it."""
        if self._code is None and self._job is not None:
            self._code = -signal.SIGTERM if isinstance(self._job, submitit.DebugJob) else None
            self._job.cancel(check=False)
            self._ask_at = time.monotonic() + ASK_S


def _note(log: Path, sentence: str) -> None:
    with log.open("a") as file:
        file.write(f"rgbt: {sentence}\n")
