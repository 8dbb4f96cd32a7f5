"""Files of a run in progress: its metrics, its log, its lock."""

from __future__ import annotations

import os
import re
import shutil
import signal
from contextlib import suppress
from pathlib import Path

from rgbt.runs.folder import MetricLine

FULL = 1_000_000
"""Bytes; a disk with less is full."""


class MetricsReader:
    """Reads ``metrics.jsonl`` of a run as it grows.

    Args:
        folder: the run folder, which need not exist yet.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / "metrics.jsonl"
        self._inode = -1
        self._offset = 0
        self.step = 0
        """Last step seen."""

    def new_lines(self) -> list[MetricLine]:
        """Whole lines since the last call; all of them again where the run has resumed.

        Damaged lines are skipped: the run itself reports them when it resumes.
        """
        try:
            with self._path.open("rb") as file:
                inode = os.fstat(file.fileno()).st_ino
                if inode != self._inode:  # a run that resumes writes the file anew
                    self._inode, self._offset = inode, 0
                file.seek(self._offset)
                whole, newline, _ = file.read().rpartition(b"\n")
        except FileNotFoundError:
            return []
        self._offset += len(whole) + len(newline)
        lines = []
        for text in whole.splitlines():
            with suppress(ValueError):
                lines += MetricLine.read_all([text])
        if lines:
            self.step = lines[-1].step
        return lines


def failure_reason(code: int, log: Path, start: int) -> str:
    """The reason why a process failed, in one sentence.

    Args:
        code: exit code; negative for a signal.
        log: file with its output.
        start: where its output begins in that file, bytes.
    """
    if code < 0:
        name = signal.Signals(-code).name if -code in set(signal.Signals) else f"signal {-code}"
        hint = " (the system kills processes that use too much memory)" if name == "SIGKILL" else ""
        return f"stopped by {name}{hint}"
    text = log.read_bytes()[start:].decode(errors="replace") if log.exists() else ""
    lines = [line.strip() for line in re.split(r"[\r\n]+", text) if line.strip()]
    # Libraries log tracebacks of errors that they handle: the last message counts.
    traced = "Traceback (most recent call last):" in lines
    error = r"[\w.]+(Error|Exception|Interrupt)\b" if traced else r"(?!)"
    messages = [line for line in lines if line.startswith("rgbt: ") or re.match(error, line)]
    if messages or lines:
        return (messages or lines)[-1].removeprefix("rgbt: ")[:300]
    # Its output went to a file on the disk that may be the reason.
    is_full = log.parent.exists() and shutil.disk_usage(log.parent).free < FULL
    where = f"see {log}" if log.exists() else "its error is in the terminal of this command"
    hint = f"the disk of {log.parent} is full" if is_full else where
    return f"it ended with exit code {code} and no output; {hint}"


def signal_lock_holder(folder: Path, number: signal.Signals) -> None:
    """Send a signal to the process that trains in `folder`, if it is on this machine."""
    lock = folder / "lock"
    text = lock.read_text(errors="replace") if lock.exists() else ""
    holder = re.fullmatch(r"process (\d+) on (\S+)", text)
    if holder and holder.group(2) == os.uname().nodename:
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.kill(int(holder.group(1)), number)
