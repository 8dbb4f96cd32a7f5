"""Runs one command to its end in a process of its own, with its output in a file."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from sweeps.worker.executors import GRACE_S
from sweeps.worker.run_monitor import failure_reason


def run_command(command: Sequence[str], log: Path) -> str:
    """Run ``python -m <command>`` and wait; the process is stopped if this one is.

    Args:
        command: module and its arguments, e.g. ("rgbt.evaluate", "run=runs/1c0ffe").
        log: file that takes stdout and stderr, appended to.

    Returns:
        "" for the exit code 0, otherwise the reason of the failure in one sentence.
    """
    log.parent.mkdir(parents=True, exist_ok=True)
    with log.open("ab") as output:
        begin = output.tell()
        process = subprocess.Popen(
            [sys.executable, "-m", *command],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
        )
        try:
            code = process.wait()
        finally:
            _stop(process)
    return failure_reason(code, log, begin) if code else ""


def _stop(process: subprocess.Popen[bytes]) -> None:
    if process.poll() is not None:
        return
    process.terminate()
    try:
        process.wait(GRACE_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
