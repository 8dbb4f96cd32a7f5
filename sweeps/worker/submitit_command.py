"""The function that a submitit job runs: a command, watched until it ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, BinaryIO

from sweeps.worker.executors import GRACE_S

if TYPE_CHECKING:
    import submitit

KILL_S = 600.0
"""How long a pre-empted job waits for SLURM to end it."""


@dataclass(frozen=True)
class Command:
    """Runs ``python -m <words>`` inside a job; its exit code is the result.

    Attributes:
        words: module and its arguments.
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
            _end(process)
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


def _end(process: subprocess.Popen[bytes]) -> None:
    """Make sure that the process is gone."""
    if process.poll() is None:
        _signal(process, signal.SIGTERM)
        # submitit kills what is not gone a second after its own Ctrl-C.
        with suppress(subprocess.TimeoutExpired):
            process.wait(0.4)
    _signal(process, signal.SIGKILL)
