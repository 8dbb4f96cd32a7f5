"""What a job does on any machine: it executes the commands of a point, each in its own process.

A job gets words alone. The run folder says what is done and at which step a run resumes, so that a
job may be stopped, repeated, or started twice.
"""

from __future__ import annotations

import os
import platform
import re
import runpy
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rgbt.checks import one_line
from rgbt.files.atomic import is_held
from rgbt.files.plain_files import read_bytes
from rgbt.runs.folder import is_finished
from rgbt.runtime.group import end_with_parent
from rgbt.runtime.signals import WORDS

TRAINING = "rgbt.run"
# What a job writes into its log: this, that it started, and how it ended.
SAYS, STARTED, DONE = "rgbt job: ", "started", "done"


@dataclass(frozen=True)
class Work:
    """Tells an executor what to do for a point.

    Attributes:
        key: of the point, unique in the folder of runs.
        steps: words of its commands (``python -m <words>``), executed in their order until one
            fails -> the folder of the run that a command trains, None for another command.
        environment: variables that the commands get.
        log: file to which their output is appended.
        folder: working folder.
    """

    key: str
    steps: Mapping[tuple[str, ...], Path | None]
    environment: Mapping[str, str]
    log: Path
    folder: Path


# Starts a command of a point: its process id, and a function that forgets a process that has ended.
Start = Callable[[Work, Sequence[str]], tuple[int, Callable[[], object]]]


def start_python(work: Work, words: Sequence[str]) -> tuple[int, Callable[[], object]]:
    """Start a command in a new interpreter."""
    with work.log.open("ab") as log:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", __name__, str(os.getpid()), *words],
            stdout=log,
            stderr=log,
            env={**os.environ, **work.environment},
            cwd=work.folder,
        )
    return process.pid, process.wait


class Job:
    """Executes the commands of a point; only its work is pickled, by submitit and Ray."""

    poll_s = 0.5

    def __init__(self, work: Work, start: Start = start_python) -> None:
        self.work, self._start = work, start
        self.is_stopped = False  # nothing more is started, and the present command is stopped
        self._pid: int | None = None  # of the present command

    def __reduce__(self) -> tuple[type[Job], tuple[Work]]:
        return type(self), (self.work,)

    def __call__(self) -> int:
        """Execute the commands; 0, or the exit code of the one that failed (negative: a signal)."""
        self.work.log.parent.mkdir(parents=True, exist_ok=True)
        self._say(f"{STARTED} on {platform.node()}")
        code = 0
        try:
            for words, run_folder in self.work.steps.items():
                code = code or self._execute(words, run_folder)
        except BaseException as error:  # a time limit, or Ray cancels: the run saves its step first
            self.stop()
            if isinstance(error, Exception):  # submitit: no more time limits
                self._say(one_line(error))
            raise
        self._say(how_ended(code))
        return code

    def stop(self) -> None:
        """Let the present command save and end; returns when it has ended."""
        self.is_stopped = True
        if self._pid is not None:
            self._wait(self._pid)

    def check(self) -> None:
        """Do nothing; it is called again and again while a command runs."""

    def _say(self, text: str) -> None:
        with self.work.log.open("ab+") as log:
            size = log.seek(0, os.SEEK_END)
            log.seek(max(0, size - 1))
            begin = "" if log.read(1) in (b"", b"\n") else "\n"  # a command was killed in a line
            log.write(f"{begin}{SAYS}{text}\n".encode())

    def _execute(self, words: Sequence[str], run_folder: Path | None) -> int:
        while True:
            # Another job, or a command of the user, trains the same run: its result is ours.
            while self._is_held(run_folder) and not self.is_stopped:
                time.sleep(self.poll_s)
                self.check()
            if self.is_stopped:
                return 128 + signal.SIGTERM
            if run_folder is not None and is_finished(run_folder):
                return 0
            self._pid, reap = self._start(self.work, words)
            code = self._wait(self._pid)
            self._pid = None  # before it is reaped: a handler of a signal may come in between
            reap()
            if code == 0 or not self._is_held(run_folder):
                return code

    def _is_held(self, run_folder: Path | None) -> bool:
        return run_folder is not None and is_held(run_folder / "lock")

    def _wait(self, pid: int) -> int:
        # The process stays known until it is reaped: a handler of a signal may wait for it too.
        options = os.WEXITED | os.WNOHANG | os.WNOWAIT
        has_signalled = False
        while (end := os.waitid(os.P_PID, pid, options)) is None:
            if self.is_stopped and not has_signalled:
                os.kill(pid, signal.SIGTERM)
                has_signalled = True
            time.sleep(self.poll_s)
            self.check()
        return end.si_status if end.si_code == os.CLD_EXITED else -end.si_status


def how_ended(code: int) -> str:
    """Return an exit code in words."""
    if code >= 0:
        return f"exit code {code}" if code else DONE
    name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
    return f"stopped by {name}{' (out of memory?)' if name == 'SIGKILL' else ''}"


LOST, TOO_LONG = "its job was lost", "stopped after timeout_minutes"
# Exit codes of a command that a signal has stopped, which resumes.
STOPPED = tuple(f"exit code {128 + n}" for n in WORDS)


def failure_reason(log: Path, begin: int) -> str:
    """Return why a job failed: the last message in its log behind byte `begin`; "": done."""
    text = read_bytes(log)[begin:].decode(errors="replace") if log.exists() else ""
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    end = _end(lines)
    if not end.startswith("exit code"):
        return end.removeprefix(DONE)
    # Libraries log tracebacks of errors that they handle: the last message counts.
    others = [line for line in lines if not line.startswith(SAYS)]
    messages = [line for line in others if re.match(r"rgbt: |[\w.]+(Error|Exception)\b", line)]
    found = [f"it ended with {end} and no output; see {log}", *others[-1:], *messages]
    return found[-1].removeprefix("rgbt: ")[:300]


def failed_before(log: Path) -> str:
    """Return why the last job with this log failed by itself; "": it did not, or was stopped."""
    if not log.exists():
        return ""
    content = read_bytes(log)
    begin = content.rfind(f"{SAYS}{STARTED}".encode())
    end = _end(content[max(0, begin) :].decode(errors="replace").splitlines())
    failed = end == TOO_LONG or (end.startswith("exit code") and end not in STOPPED)
    return failure_reason(log, max(0, begin)) if failed else ""


def _end(lines: Sequence[str]) -> str:
    said = [line.removeprefix(SAYS) for line in lines if line.startswith(SAYS)]
    ends = [text for text in said if not text.startswith(STARTED)]
    return ends[-1] if ends else LOST


def become(words: Sequence[str]) -> None:
    """Turn this process into ``python -m <words>``; leaves by SystemExit, or returns."""
    sys.argv = list(words)
    sys.orig_argv = [sys.executable, "-m", *words]
    runpy.run_module(words[0], run_name="__main__", alter_sys=True)


if __name__ == "__main__":
    # Clusters send these to every process of a job; its first one answers.
    signal.signal(signal.SIGUSR1, signal.SIG_IGN)
    signal.signal(signal.SIGUSR2, signal.SIG_IGN)
    end_with_parent(signal.SIGTERM)
    if os.getppid() != int(sys.argv[1]):  # it has ended before, and no signal will come
        sys.exit(128 + signal.SIGTERM)
    sys.path.append(str(Path.cwd()))  # last: a user's folder may hold packages of our names
    become(sys.argv[2:])
