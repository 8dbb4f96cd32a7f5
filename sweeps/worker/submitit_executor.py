"""Runs as jobs of a cluster: ``executor=submitit``, one submitit job per run.

The driver stays where it was started (a login node, inside tmux) and submits as many jobs at a time
as it has workers. Nothing of a run is kept in submitit: what is submitted is the plain command,
which continues its own run folder. So a job that SLURM preempts and requeues resumes from its
checkpoint, and so does one that reaches its time limit: submitit's signal shortly before it has
the job queued again, at most ``max_num_timeout`` times.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, Any, BinaryIO

from rgbt.checks import InputError, check_choice, nearest
from sweeps.worker.executors import GPUS, GRACE_S

if TYPE_CHECKING:
    import submitit

CLUSTERS = ("slurm", "local", "debug")
LOCAL_OPTIONS = ("timeout_min", "setup", "max_num_timeout")
YEAR_MIN = 365 * 24 * 60
"""Time limit of a local job: submitit's own is two minutes."""

NOT_OURS = {"time", "job_name", "nodes", "ntasks_per_node", "tasks_per_node", "array_parallelism"}
"""Options with a second name (timeout_min, name), or for jobs that are not one process each."""

KILL_S = 600.0
"""How long a preempted job waits for SLURM to end it."""

PATIENCE_S = 60.0
"""How long the result of a job that SLURM calls finished may take to appear on a shared disk."""

ASK_S = 5.0
"""Seconds between two queries of a job that has to stop."""

FAILED = 1
"""Exit code of a job that ended without one; its log holds the reason."""


@dataclass(frozen=True)
class Command:
    """Runs ``python -m <words>`` inside a job; its exit code is the result.

    Attributes:
        environment: variables set beside those of the job; None: unset.
        log: file that takes stdout and stderr, appended to.
        folder: working directory.
    """

    words: tuple[str, ...]
    environment: Mapping[str, str | None]
    log: str
    folder: str

    def __call__(self) -> int:
        """The exit code, negative for a signal."""
        with Path(self.log).open("ab") as log:
            process = self._start(log)
        signals: list[int] = []

        def stop(number: int, frame: FrameType | None) -> None:
            del frame
            if not signals:
                signals.append(number)
                _signal(process, signal.SIGTERM)
                killer.start()

        killer = threading.Timer(GRACE_S, _signal, (process, signal.SIGKILL))
        killer.daemon = True
        before = signal.signal(signal.SIGTERM, stop)
        try:
            code = process.wait()
        finally:
            # An exception here is Ctrl-C, or submitit that queues the job again: the command has
            # to be gone before it is started anew.
            signal.signal(signal.SIGTERM, before)
            killer.cancel()
            _signal(process, signal.SIGTERM)
            # submitit kills what is not gone a second after its own Ctrl-C.
            with suppress(subprocess.TimeoutExpired):
                process.wait(0.4)
            _signal(process, signal.SIGKILL)
        if signals and os.environ.get("SUBMITIT_EXECUTOR") == "slurm":
            # SLURM takes the node away. A job that ends before it is ended counts as done and
            # is not queued again.
            time.sleep(KILL_S)
        return code

    def checkpoint(self) -> submitit.helpers.DelayedSubmission:
        """What submitit queues when the time limit is near: the same command."""
        from submitit.helpers import DelayedSubmission

        return DelayedSubmission(self)

    def _start(self, log: BinaryIO) -> subprocess.Popen[bytes]:
        wanted = {**os.environ, **self.environment}
        # SLURM sends submitit's signal to all processes of a job, and it ends those that do not
        # expect it; a process starts with the blocked signals of its parent.
        signals = {signal.SIGUSR1, signal.SIGUSR2}
        before = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
        try:
            return subprocess.Popen(
                [sys.executable, "-m", *self.words],
                env={name: value for name, value in wanted.items() if value is not None},
                cwd=self.folder,
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _signal(process: subprocess.Popen[bytes], number: int) -> None:
    """Signal a process that leads its group, and with it the workers it has started."""
    if process.returncode is None:
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)


class SubmititExecutor:
    """Starts every run as a job; see `sweeps.worker.executors.Executor`.

    Args:
        folder: where submitit keeps what it writes, a folder for each job; for SLURM on a disk that
            the nodes share.
        options: ``cluster`` ("slurm", "local": processes of this machine, "debug": inside the
            driver, one after the other) and submitit's parameters, with or without ``slurm_`` in
            front: timeout_min, partition, gpus_per_node, cpus_per_task, mem_gb,
            additional_parameters, max_num_timeout, ...

    Raises:
        InputError: submitit or SLURM is missing, an option is unknown or has a wrong value.
    """

    def __init__(self, folder: Path, options: Mapping[str, Any]) -> None:
        try:
            import submitit
        except ImportError as error:
            raise InputError(
                "executor=submitit needs a package that is not installed: "
                "pip install 'rgbt[cluster]'."
            ) from error
        self._submitit = submitit
        self._cluster = str(options.get("cluster", "slurm"))
        check_choice("submitit.cluster", self._cluster, CLUSTERS)
        values = self._checked({k: v for k, v in options.items() if k != "cluster"})
        limit = {}
        if "max_num_timeout" in values:
            limit[f"{self._cluster}_max_num_timeout"] = values.pop("max_num_timeout")
        try:
            self._executor = self._submitit.AutoExecutor(
                Path(folder).resolve() / "%j", cluster=self._cluster, **limit
            )
            self._executor.update_parameters(**self._named(values))
        except RuntimeError as error:
            raise InputError(
                "executor=submitit: this machine has no `srun`; start the command on a login node "
                "of the cluster, or use submitit.cluster=local."
            ) from error
        except (AssertionError, TypeError, ValueError) as error:
            raise InputError(f"submitit={dict(options)}: {str(error).splitlines()[0]}") from error

    def start(
        self, command: Sequence[str], environment: Mapping[str, str], log: Path
    ) -> SubmititJob:
        """See `Executor.start`; a job that the cluster refuses fails with the reason.

        Raises:
            InputError: a GPU of the driver's machine is requested on SLURM.
        """
        log.parent.mkdir(parents=True, exist_ok=True)
        wanted: dict[str, str | None] = dict(environment)
        if self._cluster == "slurm" and GPUS in wanted:
            raise InputError(
                "gpus=[...] selects GPUs of this machine; with executor=submitit, the cluster "
                "assigns GPUs to each run: set submitit.gpus_per_node=1."
            )
        if self._cluster == "local":
            # submitit hides all GPUs from a local job that did not ask for a number of them.
            wanted.setdefault(GPUS, os.environ.get(GPUS))
        task = Command(tuple(command), wanted, str(log.resolve()), str(Path.cwd()))
        errors = self._submitit.core.utils
        try:
            job = self._executor.submit(task)
        except (errors.FailedJobError, errors.FailedSubmissionError, OSError) as error:
            _note(log, f"the job was not accepted: {_first_line(error)}")
            return SubmititJob(None, log, self._cluster)
        return SubmititJob(job, log, self._cluster)

    def _checked(self, options: Mapping[str, Any]) -> dict[str, Any]:
        """Options by submitit's name without prefix."""
        if self._cluster == "slurm":  # as submitit itself lists them
            shared = self._submitit.AutoExecutor._valid_parameters()
            names = shared | self._submitit.SlurmExecutor._valid_parameters()
            known = sorted({*names, "max_num_timeout"} - NOT_OURS)
        else:
            known = list(LOCAL_OPTIONS) if self._cluster == "local" else []
        values = {key.removeprefix(f"{self._cluster}_"): value for key, value in options.items()}
        for key in values:
            if key not in known:
                raise InputError(
                    f"'submitit.{key}' is not an option of cluster={self._cluster}; "
                    f"{nearest(key, known)}."
                )
        if self._cluster == "slurm" and values.get("timeout_min") is None:
            raise InputError(
                "submitit.timeout_min has no value; set the time limit of a job in minutes, at "
                "most the limit of the partition (see `sinfo`)."
            )
        return values

    def _named(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Values by the names that `AutoExecutor.update_parameters` takes."""
        if self._cluster == "debug":
            return {}
        defaults: dict[str, Any] = {"name": "rgbt", "timeout_min": YEAR_MIN}
        if "cpus_per_task" in values:
            # From SLURM 22.05 on, a step does not take over the cores of its job by itself.
            defaults["srun_args"] = [f"--cpus-per-task={values['cpus_per_task']}"]
        shared = self._submitit.AutoExecutor._valid_parameters()
        return {
            key if key in shared else f"{self._cluster}_{key}": value
            for key, value in {**defaults, **values}.items()
        }


class SubmititJob:
    """A job of the cluster; see `sweeps.worker.executors.Job`.

    Args:
        job: None: it was refused.
        log: of the run; gets a line if the job ends without an exit code.
        cluster: one of `CLUSTERS`.
    """

    def __init__(self, job: submitit.Job[int] | None, log: Path, cluster: str) -> None:
        self._job = job
        self._log = log
        self._cluster = cluster
        self._code: int | None = FAILED if job is None else None
        self._patience_s = PATIENCE_S if cluster == "slurm" else 0.0
        self._gone_at: float | None = None
        self._ask_at: float | None = None

    def poll(self) -> int | None:
        """See `Job.poll`. Cheap: submitit looks for a file, and asks SLURM more and more rarely.

        A job that SLURM ends without a message is detected within ten minutes.
        """
        if self._code is None and self._job is not None and self._is_done(self._job):
            self._code = self._outcome(self._job)
        return self._code

    def stop(self) -> None:
        """See `Job.stop`; a job that waits in the queue leaves it."""
        if self._code is not None or self._job is None:
            return
        if self._cluster == "debug":
            self._code = -signal.SIGTERM
        self._cancel(self._job)
        self._ask_at = time.monotonic() + ASK_S

    def _cancel(self, job: submitit.Job[int]) -> None:
        if self._cluster != "local":
            job.cancel(check=False)
            return
        # submitit's own way leaves a run one second to go; the number of a local job is that of the
        # process that looks after it, which hands the signal on.
        with suppress(ProcessLookupError):
            os.kill(int(job.job_id), signal.SIGTERM)

    def _is_done(self, job: submitit.Job[int]) -> bool:
        if self._ask_at is None or time.monotonic() < self._ask_at:
            return bool(job.done())
        self._ask_at = time.monotonic() + ASK_S
        if job.done(force_check=True):
            return True
        if self._cluster == "local":
            # The first signal may have come before anybody listened.
            self._cancel(job)
        return False

    def _outcome(self, job: submitit.Job[int]) -> int | None:
        """The exit code of a job that is done; None while it may still appear."""
        if self._cluster == "debug" or job.paths.result_pickle.exists():
            error = job.exception()
            return int(job.result()) if error is None else self._lost(job, _last_line(error))
        now = time.monotonic()
        self._gone_at = now if self._gone_at is None else self._gone_at
        if now - self._gone_at < self._patience_s:
            return None
        return self._lost(job, f"no result, state {job.state}")

    def _lost(self, job: submitit.Job[int], reason: str) -> int:
        _note(self._log, f"job {job.job_id} ended ({reason}); see {job.paths.stderr}.")
        return FAILED if self._ask_at is None else -signal.SIGTERM


def _note(log: Path, sentence: str) -> None:
    with log.open("a") as file:
        file.write(f"rgbt: {sentence}\n")


def _first_line(error: BaseException) -> str:
    return (str(error).strip().splitlines() or [type(error).__name__])[0]


def _last_line(error: BaseException) -> str:
    """The last line of the trace that submitit wraps into its own sentences."""
    lines = [line for line in str(error).splitlines() if line.strip()]
    marks = [index for index, line in enumerate(lines) if line.startswith("-----")]
    return lines[marks[1] - 1] if len(marks) > 1 else _first_line(error)
