"""Processes of runs on this machine, forked from one that has imported torch and MLflow.

That process is Python's fork server. It starts with the first run, so that all runs of a sweep
execute the code of that moment (`sweeps.worker.preload`); no state is carried from run to run.
"""

from __future__ import annotations

import multiprocessing
import os
import re
import runpy
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from rgbt.checks import InputError
from rgbt.cores import sleep_while_waiting
from rgbt.runs.source_code import counted_modules

CWD_LAST, PRELOADED = "rgbt.runtime.cwd_last", "sweeps.worker.preload"
GPUS = "CUDA_VISIBLE_DEVICES"
# Time between SIGTERM and SIGKILL of a process that is stopped.
GRACE_S = 20.0


class LocalExecutor:
    """Processes on this machine, at most `workers` at a time."""

    def __init__(self, workers: int = 1) -> None:
        if workers > 1:
            sleep_while_waiting()
        self._context = multiprocessing.get_context("forkserver")

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> LocalJob:
        """Start ``python -m <command>`` with more variables; its output is appended to `log`."""
        log.parent.mkdir(parents=True, exist_ok=True)
        # The user's own modules that planned points have read are imported too. This has no effect
        # once the server runs.
        self._context.set_forkserver_preload([CWD_LAST, *counted_modules(), PRELOADED])
        arguments = (tuple(command), dict(environment), str(log), str(Path.cwd()))
        process = self._context.Process(target=_run_module, args=arguments)
        process.start()
        return LocalJob(process)


class LocalJob:
    """A process that was started; it leads a process group, so that its workers go with it."""

    def __init__(self, process: multiprocessing.process.BaseProcess) -> None:
        self._process = process
        self._kill_at = float("inf")

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        if self._process.exitcode is None and time.monotonic() > self._kill_at:
            self._signal(signal.SIGKILL)
        return self._process.exitcode

    def stop(self) -> None:
        """Request that it stops; if it does not, later calls of `poll` kill it."""
        self._kill_at = min(self._kill_at, time.monotonic() + GRACE_S)
        self._signal(signal.SIGTERM)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process.pid is not None, "a started process has a number"
        with suppress(ProcessLookupError):  # gone already
            is_leader = os.getpgid(self._process.pid) == self._process.pid
            (os.killpg if is_leader else os.kill)(self._process.pid, number)


def _run_module(words: Sequence[str], variables: Mapping[str, str], log: str, folder: str) -> None:
    """Become, in the new process, ``python -m <words>``; Ctrl-C is for the driver alone."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.update(variables)
    os.chdir(folder)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (1, 2):
        os.dup2(output, stream)
    sys.stdout.reconfigure(line_buffering=True)  # type: ignore[union-attr]
    sys.argv = list(words)
    sys.orig_argv = [sys.executable, "-m", *words]
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)


def run_command(command: Sequence[str], log: Path) -> str:
    """Run ``python -m <command>`` to its end; "" or the reason of its failure in one sentence."""
    begin = log.stat().st_size if log.exists() else 0
    job = LocalExecutor().start(command, {}, log)
    try:
        while (code := job.poll()) is None:
            time.sleep(0.05)
    except BaseException:
        job.stop()
        while job.poll() is None:
            time.sleep(0.05)
        raise
    return failure_reason(code, log, begin) if code else ""


def failure_reason(code: int, log: Path, begin: int) -> str:
    """Why a process failed: its signal, or the last message in its log behind byte `begin`."""
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        return f"stopped by {name}{' (out of memory?)' if name == 'SIGKILL' else ''}"
    text = log.read_bytes()[begin:].decode(errors="replace") if log.exists() else ""
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    # Libraries log tracebacks of errors that they handle: the last message counts.
    messages = [line for line in lines if re.match(r"rgbt: |[\w.]+(Error|Exception)\b", line)]
    found = [f"it ended with exit code {code} and no output; see {log}", *lines[-1:], *messages]
    return found[-1].removeprefix("rgbt: ")[:300]


def gpus_of(slot: int | tuple[int, ...]) -> list[str]:
    """The GPUs of one entry of `gpus`."""
    return [str(slot)] if isinstance(slot, int) else list(map(str, slot))


def check_gpus(gpus: Sequence[int | tuple[int, ...]] | None) -> None:
    """Refuse GPUs that this machine does not have or hides: a run would train on the CPU."""
    for number in (each for slot in gpus or () for each in gpus_of(slot)):
        shown = os.environ.get(GPUS)
        if shown is None:
            import torch

            shown = ",".join(map(str, range(torch.cuda.device_count())))
        if number not in [word.strip() for word in shown.split(",")]:
            raise InputError(f"gpus: no GPU {number}; this machine shows {shown or 'none'}.")
