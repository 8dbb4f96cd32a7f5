"""Jobs on this machine, forked from a process that has imported torch and MLflow.

That process is Python's fork server. It starts with the first job, so that all runs of a sweep
execute the code of that moment (`sweeps.run.preload`); no state is carried from run to run.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType

from rgbt.checks import InputError, RunError, of_posix
from rgbt.cores import sleep_while_waiting
from rgbt.runs.source_code import counted_modules
from rgbt.runtime.group import end_with_parent
from sweeps.run.job import Job, Work, become, failure_reason
from sweeps.settings import GpuSlot

CWD_LAST, PRELOADED = "rgbt.runtime.cwd_last", "sweeps.run.preload"
GPUS = "CUDA_VISIBLE_DEVICES"
# Time between SIGTERM and SIGKILL of a job that is cancelled, and between two looks at a process.
GRACE_S, POLL_S = 20.0, 0.05


class LocalExecutor:
    """Executes jobs on this machine, `slots` at a time; the n-th slot sees the n-th of `gpus`."""

    is_lasting = False

    def __init__(self, slots: int = 1, gpus: Sequence[GpuSlot] | None = None) -> None:
        if slots > 1:
            sleep_while_waiting()
        check_gpus(gpus)
        self.slots, self._gpus = slots, gpus
        of_posix("os.fork", "hydra/launcher=basic, which forks the runs of a sweep,")
        self._context = multiprocessing.get_context("forkserver")
        self._processes: dict[str, BaseProcess] = {}  # by job
        self._jobs: dict[int, str] = {}  # the last one of each slot
        self._kill_at: dict[str, float] = {}  # by job

    def submit(self, works: Sequence[Work]) -> list[str]:
        """Start jobs and return their names. RunError: the machine starts no process."""
        return [self._start(work) for work in works]

    def state(self, job: str) -> str:
        """See `Executor.state`; a job that does not stop in time is killed."""
        process = self._processes[job]
        if process.exitcode is None and time.monotonic() > self._kill_at.get(job, float("inf")):
            _signal(process, signal.SIGKILL)
        return "running" if process.exitcode is None else "ended"

    def cancel(self, job: str) -> None:
        """Let the present command save and end, with all that it has started."""
        self._kill_at.setdefault(job, time.monotonic() + GRACE_S)
        if self._processes[job].exitcode is None:
            _signal(self._processes[job], signal.SIGTERM)

    def _start(self, work: Work) -> str:
        # The user's own modules that planned points have read are imported too. This has no effect
        # once the server runs.
        self._context.set_forkserver_preload([CWD_LAST, *counted_modules(), PRELOADED])
        slot = 0
        while slot in self._jobs and self.state(self._jobs[slot]) == "running":
            slot += 1
        if self._gpus:
            variables = {GPUS: ",".join(gpus_of(self._gpus[slot % len(self._gpus)]))}
            work = replace(work, environment={**work.environment, **variables})
        process = self._context.Process(target=_execute, args=(work,))
        try:
            process.start()
        except OSError as error:
            raise RunError(f"its process could not be started ({error})") from error
        job = str(process.pid)
        self._processes[job], self._jobs[slot] = process, job
        return job


def _execute(work: Work) -> None:
    """Execute a job in the process that was forked for it: the leader of a process group."""
    os.setsid()
    os.chdir(work.folder)
    job = Job(work, _fork)
    job.poll_s = POLL_S

    def stop(number: int, frame: FrameType | None) -> None:
        del number, frame
        job.is_stopped = True

    signal.signal(signal.SIGTERM, stop)
    sys.exit(max(0, job()))


def _fork(work: Work, words: Sequence[str]) -> tuple[int, Callable[[], object]]:
    """Fork a command from this process, so that it need not import anything again."""
    arguments = (tuple(words), work.environment, str(work.log))
    process = multiprocessing.get_context("fork").Process(target=_command, args=arguments)
    process.start()
    assert process.pid is not None, "a started process has a number"
    return process.pid, process.join


def _command(words: Sequence[str], variables: Mapping[str, str], log: str) -> None:
    end_with_parent(signal.SIGTERM)  # nobody would know of a run that continues
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.update(variables)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (1, 2):
        os.dup2(output, stream)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    become(words)


def _signal(process: BaseProcess, number: signal.Signals) -> None:
    assert process.pid is not None, "a started process has a number"
    with suppress(ProcessLookupError):  # gone already
        is_leader = os.getpgid(process.pid) == process.pid
        (os.killpg if is_leader else os.kill)(process.pid, number)


def run_command(words: Sequence[str], log: Path) -> str:
    """Run ``python -m <words>`` to its end; return "" or why it failed, in one sentence."""
    begin = log.stat().st_size if log.exists() else 0
    executor = LocalExecutor()
    (job,) = executor.submit([Work(log.stem, {tuple(words): None}, {}, log, Path.cwd())])
    try:
        _wait(executor, job)
    except BaseException:
        executor.cancel(job)
        _wait(executor, job)
        raise
    return failure_reason(log, begin)


def _wait(executor: LocalExecutor, job: str) -> None:
    while executor.state(job) == "running":
        time.sleep(POLL_S)


def gpus_of(slot: GpuSlot) -> list[str]:
    """Return the numbers of the GPUs in one entry of `gpus`."""
    numbers = (slot,) if isinstance(slot, int) else slot
    return [str(number) for number in numbers]


def check_gpus(gpus: Sequence[GpuSlot] | None) -> None:
    """Refuse GPUs that this machine does not have or hides: a run would train on the CPU."""
    needed = [number for slot in gpus or () for number in gpus_of(slot)]
    if not needed:
        return
    shown = os.environ.get(GPUS)
    if shown is None:
        import torch

        shown = ",".join(str(number) for number in range(torch.cuda.device_count()))
    known = [word.strip() for word in shown.split(",")]
    for number in needed:
        if number not in known:
            raise InputError(f"gpus: no GPU {number}; this machine shows {shown or 'none'}.")
