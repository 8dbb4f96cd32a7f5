"""Starts commands as processes of this machine, forked from one that is warmed up.

Importing torch and MLflow takes longer than a small run's first step. One process imports them and
forks a fresh process for every run: no state is carried from run to run, and the code is that of
the start of the driver, also if a file is edited meanwhile. That process is a fork of the command
(`fork_template`); where a driver is no command of its own, it is Python's fork server.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pkgutil
import runpy
import signal
import sys
import time
from collections.abc import Mapping, Sequence
from multiprocessing import forkserver
from pathlib import Path
from typing import Protocol, TextIO

import rgbt
from rgbt.checks import InputError
from rgbt.runs.source_code import counted_modules
from sweeps.worker.template import Template, TemplateProcess

MLFLOW = ("mlflow", "mlflow.store.tracking.sqlalchemy_store")
PRELOADED = ("sweeps.worker.executors", "torch", "hydra")
PRELOADED_LAST = "sweeps.worker.preload"
COMMANDS = ("rgbt.run", "rgbt.evaluate", "rgbt.consistency")
"""Run as programs, and a few lines each: not imported before."""

GPUS = "CUDA_VISIBLE_DEVICES"

GRACE_S = 20.0
"""Time between SIGTERM and SIGKILL of a process that is stopped."""


class Job(Protocol):
    """A process that was started."""

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""

    def stop(self) -> None:
        """Request that it stops; if it does not, later calls of `poll` kill it."""


class Executor(Protocol):
    """Starts commands; it does not wait for them."""

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Job:
        """Start ``python -m <command>``.

        Args:
            command: module and its arguments, e.g. ("rgbt.run", "+experiment=grbm").
            environment: variables set beside those of this process.
            log: file that takes stdout and stderr, appended to.
        """


_templates: list[Template] = []
"""The template of this command, if it has one."""


def limit_spinning(workers: int) -> None:
    """Let threads that wait sleep if several runs share the cores; before torch is imported.

    A run has a fixed number of threads: those of one that wait in a loop would take the cores of
    the others (2.3 times slower). A run alone is faster with them (1.15 to 1.5).
    """
    if workers > 1:
        os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")


def fork_template(*, with_mlflow: bool) -> None:
    """Fork the process from which the runs of this command are started.

    Call it once, before a store is opened or a point is planned.

    Args:
        with_mlflow: whether runs send their results to MLflow.
    """
    shared = (*PRELOADED, *(MLFLOW if with_mlflow else ()))
    for name in shared:
        importlib.import_module(name)
    _templates[:] = [Template(own_modules(), _record_code)]


def _record_code() -> None:
    from sweeps.worker.preload import record_code  # it records the code when it is imported

    record_code()


class LocalExecutor:
    """Processes on this machine, at most `workers` at a time."""

    def __init__(self, workers: int = 1) -> None:
        limit_spinning(workers)
        self._context = multiprocessing.get_context("forkserver")
        self._is_preloaded = False

    def start(self, command: Sequence[str], environment: Mapping[str, str], log: Path) -> Job:
        """See `Executor.start`."""
        log.parent.mkdir(parents=True, exist_ok=True)
        arguments = (tuple(command), dict(environment), str(log), str(Path.cwd()))
        if _templates:
            # Points that are planned have imported what the user wrote for them.
            return LocalJob(_templates[0].start(_run_module, arguments, counted_modules()))
        if not self._is_preloaded:
            modules = (*PRELOADED, *MLFLOW, *own_modules(), *counted_modules(), PRELOADED_LAST)
            self._context.set_forkserver_preload(list(modules))
            forkserver.ensure_running()
            self._is_preloaded = True
        process = self._context.Process(target=_run_module, args=arguments)
        # Ctrl-C in the terminal is for the driver, which then stops its jobs in order.
        process.start()
        return LocalJob(process)


def gpus_of(slot: int | tuple[int, ...]) -> tuple[int, ...]:
    """The GPUs of one entry of `gpus`."""
    return (slot,) if isinstance(slot, int) else slot


def check_gpus(gpus: Sequence[int | tuple[int, ...]] | None) -> None:
    """Refuse numbers of GPUs that this machine does not have or that are hidden."""
    if gpus is None:
        return
    shown = os.environ.get(GPUS)
    if shown is None:
        import torch  # takes seconds: only where GPUs are named

        known = [str(number) for number in range(torch.cuda.device_count())]
    else:
        known = [word.strip() for word in shown.split(",") if word.strip()]
    shown_slots = [slot if isinstance(slot, int) else list(slot) for slot in gpus]
    for number in (each for slot in gpus for each in gpus_of(slot)):
        if str(number) not in known:
            here = "this machine" if shown is None else f"{GPUS}={shown}"
            found = f"the GPUs {', '.join(known)} only; choose" if known else "no GPU; omit"
            raise InputError(
                f"gpus={shown_slots}: there is no GPU {number}, {here} shows {found} "
                f"{'some of these' if known else 'gpus'}."
            )


def own_modules() -> list[str]:
    """Every module of rgbt but the commands themselves, so that later edits reach no run."""
    modules = pkgutil.walk_packages(rgbt.__path__, "rgbt.")
    names = [module.name for module in modules if not module.name.endswith("__main__")]
    return [name for name in names if name not in COMMANDS]


class LocalJob:
    """See `Job`. The process leads a process group, so that its workers go with it."""

    def __init__(self, process: multiprocessing.process.BaseProcess | TemplateProcess) -> None:
        self._process = process
        self._kill_at = float("inf")

    def poll(self) -> int | None:
        """See `Job.poll`."""
        if self._process.exitcode is None and time.monotonic() > self._kill_at:
            self._signal(signal.SIGKILL)
        return self._process.exitcode

    def stop(self) -> None:
        """See `Job.stop`."""
        self._kill_at = min(self._kill_at, time.monotonic() + GRACE_S)
        self._signal(signal.SIGTERM)

    def _signal(self, number: signal.Signals) -> None:
        assert self._process.pid is not None, "a started process has a number"
        try:
            os.killpg(self._process.pid, number)
        except ProcessLookupError:  # not yet the leader of its group, or gone already
            if self._process.exitcode is None:
                os.kill(self._process.pid, number)


def _run_module(
    command: Sequence[str], environment: Mapping[str, str], log: str, folder: str
) -> None:
    """In the new process: become ``python -m <command>``."""
    os.setsid()
    signal.signal(signal.SIGINT, signal.default_int_handler)
    os.environ.update(environment)
    os.chdir(folder)
    output = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    for stream in (1, 2):
        os.dup2(output, stream)
    # Not the objects of the command, which may write elsewhere.
    sys.stdout, sys.stderr = _stream(1), _stream(2)
    module, *arguments = command
    sys.argv = [module, *arguments]
    sys.orig_argv = [sys.executable, "-m", *command]
    runpy.run_module(module, run_name="__main__", alter_sys=True)


def _stream(number: int) -> TextIO:
    # Open until the process ends, like those of Python.
    return open(  # noqa: SIM115
        number, "w", buffering=1, encoding="utf-8", errors="backslashreplace", closefd=False
    )
