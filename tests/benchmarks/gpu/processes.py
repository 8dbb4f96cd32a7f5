"""Run one process with a limit; at the limit, end it and every process that it started."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path

GRACE = 1.0
"""Seconds between SIGTERM and SIGKILL."""

POLL = 0.05
"""Seconds between two looks at the process."""

SCAN = 1.0
"""Seconds between two looks at the processes that it started."""


def run(
    command: Sequence[str],
    seconds: float,
    log: Path,
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
) -> int | None:
    """The exit code of a command, negative for a signal; None where it was ended at its limit.

    Its output is appended to `log`. Processes that it leaves behind are ended too, also when this
    function is interrupted. `folder` is its working folder, None for that of this process.
    """
    with log.open("ab") as output:
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=dict(os.environ if environment is None else environment),
            cwd=folder,
            start_new_session=True,
        )
    end = time.monotonic() + seconds
    family: dict[int, str] = {}
    scanned = -SCAN
    try:
        while process.poll() is None and time.monotonic() < end:
            if time.monotonic() - scanned > SCAN:
                family |= descendants(process.pid)
                scanned = time.monotonic()
            time.sleep(POLL)
        return process.poll()
    finally:
        family |= descendants(process.pid)
        _end(process, family)


def descendants(pid: int) -> dict[int, str]:
    """Live processes that `pid` started, directly or not, with their start times; {} without /proc.

    A number and a start time name one process: numbers are used again.
    """
    children: dict[int, list[tuple[int, str]]] = {}
    for entry in Path("/proc").glob("[0-9]*"):
        values = _stat(int(entry.name))
        if values:
            children.setdefault(int(values[1]), []).append((int(entry.name), values[19]))
    found: dict[int, str] = {}
    waiting = [pid]
    while waiting:
        for child, began in children.get(waiting.pop(), ()):
            if child not in found:
                found[child] = began
                waiting.append(child)
    return found


def _end(process: subprocess.Popen[bytes], family: Mapping[int, str]) -> None:
    """End a process and those that it started; it gets SIGTERM first."""
    if process.poll() is None:
        process.terminate()
        with suppress(subprocess.TimeoutExpired):
            process.wait(GRACE)
    for pid, began in family.items():
        values = _stat(pid)
        if values and values[19] == began:
            with suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
    if process.poll() is None:
        process.kill()
    process.wait()


def _stat(pid: int) -> list[str]:
    """Fields of /proc/PID/stat from the state on; [] where there is no such process."""
    with suppress(OSError):
        # The name in brackets may contain spaces and brackets.
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return []
