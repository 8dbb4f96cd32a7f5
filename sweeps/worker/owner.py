"""The driver that executes a trial, and whether it is still alive."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

HEARTBEAT_S = 20.0
"""Seconds between two heartbeats of a driver."""

STALE_S = 180.0
"""A driver on another machine is dead after so many seconds without a heartbeat."""


@dataclass(frozen=True)
class Owner:
    """A driver: one process on one machine.

    Attributes:
        host: name of the machine.
        pid: number of the process.
        started: when the process began, in ticks since the machine did; distinguishes it from a
            later process with the same number.
    """

    host: str
    pid: int
    started: str

    @classmethod
    def this_process(cls) -> Owner:
        """This process."""
        return cls(os.uname().nodename, os.getpid(), _started(os.getpid()))

    @classmethod
    def unknown(cls) -> Owner:
        """A driver without a name: only its last heartbeat counts."""
        return cls("?", 0, "")

    @classmethod
    def parse(cls, text: str) -> Owner:
        """The inverse of `str`."""
        host, pid, started = text.rsplit(":", 2)
        return cls(host, int(pid), started)

    def __str__(self) -> str:
        return f"{self.host}:{self.pid}:{self.started}"

    def is_alive(self, heartbeat: float) -> bool:
        """Whether the driver is still running.

        Args:
            heartbeat: time of its last heartbeat, seconds since 1970; all that counts on another
                machine.
        """
        if self.host == os.uname().nodename:
            return _started(self.pid) == self.started
        return time.time() - heartbeat < STALE_S


def _started(pid: int) -> str:
    """Start of a process according to the kernel; "" if it does not exist or is a zombie."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if after_name[0] in "ZX" else after_name[19]
