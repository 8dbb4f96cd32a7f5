"""Jobs of SLURM, or of its substitute on this machine, submitted by submitit.

The settings are those of the published plugin `hydra-submitit-launcher`. submitit queues a job
again near its time limit and after pre-emption; its run resumes from the step in the run folder.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import submitit
from submitit.core.utils import FailedJobError, FailedSubmissionError
from submitit.helpers import DelayedSubmission

from rgbt.checks import InputError, RunError, one_line
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import read_json, write_json
from sweeps.run.job import Job, Work

# Folder in the folder of runs: the job of each point, and files that stop them. submitit itself
# finds jobs again by their number alone, asks sacct, which not every cluster has, and only kills.
JOBS = ".jobs"
# Most jobs of an array that SLURM accepts by default.
MOST_JOBS = 1000
# Seconds between two questions to SLURM's controller, which serves all users.
ASK_S = 5.0
# Seconds that a job waits for its end after somebody else has stopped its command: SLURM queues a
# job again that it preempts, but not one that ends by itself.
PREEMPTION_S = 300.0

# Settings of the plugin that submitit takes without the name of the cluster before it.
SHARED = (
    *("timeout_min", "cpus_per_task", "gpus_per_node", "tasks_per_node", "mem_gb", "nodes"),
    *("name", "stderr_to_stdout"),
)

JOB_ID = re.compile(r"\d+(_\d+)?")
QUEUED = ("PENDING", "CONFIGURING", "REQUEUED", "REQUEUE_HOLD", "REQUEUE_FED", "SPECIAL_EXIT")
RUNNING = ("RUNNING", "COMPLETING", "SUSPENDED", "STOPPED", "SIGNALING", "STAGE_OUT", "RESIZING")


class SubmititJob(Job):
    """Executes a job until a file stops it, and is queued again near its time limit."""

    def __call__(self) -> int:
        """See `Job`."""
        code = super().__call__()
        if code in (-signal.SIGTERM, 128 + signal.SIGTERM) and not self.is_stopped:
            time.sleep(PREEMPTION_S)
        return code

    def check(self) -> None:
        """See `Job.check`."""
        self.is_stopped = self.is_stopped or stop_file(self.work).exists()

    def checkpoint(self) -> DelayedSubmission:
        """Save the step, and return what is queued again; submitit calls it for a signal."""
        self.stop()
        return DelayedSubmission(SubmititJob(self.work))


class SubmititExecutor:
    """Executes jobs on a cluster ("slurm"), or on this machine ("local")."""

    def __init__(self, cluster: str, options: Mapping[str, Any], workers: int | None) -> None:
        self._cluster, self._executor = cluster, _executor(cluster, options)
        self.is_lasting = cluster == "slurm"
        self.slots = workers or (MOST_JOBS if cluster == "slurm" else 1)
        self._works: dict[str, Work] = {}
        self._jobs: dict[str, Any] = {}  # of this machine: objects of submitit
        self._states: dict[str, str] = {}
        self._asked_at = float("-inf")

    def submit(self, works: Sequence[Work]) -> list[str]:
        """See `Executor.submit`; several jobs are one array."""
        if self._cluster == "slurm" and any(record(work).is_file() for work in works):
            self._ask()
        found = {work.key: self._queued_before(work) for work in works}
        new = [work for work in works if not found[work.key]]
        for work in new:
            stop_file(work).parent.mkdir(parents=True, exist_ok=True)
            stop_file(work).unlink(missing_ok=True)
        try:
            with self._executor.batch(allow_implicit_submissions=True):
                jobs = [self._executor.submit(SubmititJob(work)) for work in new]
        except (FailedJobError, FailedSubmissionError, OSError) as error:
            raise RunError(f"{self._cluster}: {one_line(error)}") from error
        for work, job in zip(new, jobs, strict=True):
            found[work.key], self._jobs[job.job_id] = job.job_id, job
            if self._cluster == "slurm":
                write_json(record(work), {"job": job.job_id})
        self._works |= {found[work.key]: work for work in works}
        self._states |= {job.job_id: "queued" for job in jobs}
        return [found[work.key] for work in works]

    def state(self, job: str) -> str:
        """See `Executor.state`; of SLURM with the word of its controller."""
        if self._cluster == "local":
            return "ended" if self._jobs[job].done() else "running"
        if time.monotonic() - self._asked_at > ASK_S:
            with suppress(RunError):  # a controller that is busy
                self._ask()
        state = self._states.get(job, "ended")
        is_known = state == "failed" and job in self._jobs
        return f"failed; see {self._jobs[job].paths.stderr}" if is_known else state

    def _ask(self) -> None:
        self._asked_at = time.monotonic()
        try:
            self._states = states_of_slurm()
        except (OSError, subprocess.SubprocessError) as error:
            raise RunError(f"slurm: {one_line(error)}; rerun the command.") from error

    def cancel(self, job: str) -> None:
        """See `Executor.cancel`."""
        write_atomic(stop_file(self._works[job]), b"")
        if self._cluster == "slurm":
            subprocess.run(["scancel", "--quiet", "--state=PENDING", job], check=False)
            self._asked_at = float("-inf")

    def _queued_before(self, work: Work) -> str:
        """Return the job of a point that an earlier driver has submitted and that has not ended."""
        # A job that was told to stop may still save its step; the next one waits for its run.
        if self._cluster != "slurm" or not record(work).is_file() or stop_file(work).exists():
            return ""
        known = read_json(record(work), dict[str, str], "remove it").get("job", "")
        is_there = JOB_ID.fullmatch(known) and self._states.get(known) in ("queued", "running")
        return known if is_there else ""


def record(work: Work) -> Path:
    """Return the file that names the job of a point."""
    return work.log.parent.parent / JOBS / f"{work.key}.json"


def stop_file(work: Work) -> Path:
    """Return the file whose existence stops the job of a point."""
    return record(work).with_suffix(".stop")


def states_of_slurm() -> dict[str, str]:
    """Return the states of this user's jobs; SLURM forgets one some minutes after its end."""
    command = ("squeue", "--noheader", "--array", "--states=all", "--format=%i|%T")
    # Filters of the user (SQUEUE_PARTITION) would hide jobs; nor need USER be who submits.
    environment = {name: value for name, value in os.environ.items() if name[:7] != "SQUEUE_"}
    text = subprocess.run(
        [*command, f"--user={os.getuid()}"],
        check=True,
        capture_output=True,
        text=True,
        timeout=60,
        env=environment,
    ).stdout
    states = {}
    for line in text.splitlines():
        if "|" in line:
            job, state = line.strip().split("|")
            states[job] = _word(state)
    return states


def _word(state: str) -> str:
    if state in QUEUED:
        return "queued"
    if state in RUNNING:
        return "running"
    return "ended" if state == "COMPLETED" else state.lower().replace("_", " ")


def _executor(cluster: str, options: Mapping[str, Any]) -> submitit.AutoExecutor:
    given = dict(options)
    for name in ("nodes", "tasks_per_node"):
        if given.get(name, 1) != 1:
            raise InputError(
                f"hydra.launcher.{name}={given[name]}: a job is one process, which starts those of "
                "trainer.devices itself."
            )
    folder, timeouts = given.pop("submitit_folder"), given.pop("max_num_timeout", None)
    limits = {} if timeouts is None else {f"{cluster}_max_num_timeout": timeouts}
    parameters = {
        name if name in SHARED else f"{cluster}_{name}": value for name, value in given.items()
    }
    try:
        executor = submitit.AutoExecutor(folder, cluster=cluster, **limits)
        executor.update_parameters(**parameters)
    except (RuntimeError, ValueError, TypeError, NameError, AssertionError) as error:
        raise InputError(f"hydra/launcher=submitit_{cluster}: {one_line(error)}") from error
    return executor
