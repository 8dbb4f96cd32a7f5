"""Who works on a trial, and whether that driver is still there."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from pathlib import Path

HEARTBEAT_S = 20.0
"""Seconds between two signs of life of a driver."""

STALE_S = 180.0
"""A driver on another machine that was silent for so long is taken for dead."""


@dataclass(frozen=True)
class Owner:
    """A driver: one process on one machine.

    Attributes:
        host: name of the machine.
        pid: number of the process.
        started: when the process began, in ticks since the machine did; tells it from a later
            process with the same number.
    """

    host: str
    pid: int
    started: str

    @classmethod
    def me(cls) -> Owner:
        """This process."""
        return cls(os.uname().nodename, os.getpid(), _started(os.getpid()))

    @classmethod
    def unknown(cls) -> Owner:
        """A driver that did not say who it is: only its last sign counts."""
        return cls("?", 0, "")

    @classmethod
    def parse(cls, text: str) -> Owner:
        """The inverse of `str`."""
        host, pid, started = text.rsplit(":", 2)
        return cls(host, int(pid), started)

    def __str__(self) -> str:
        return f"{self.host}:{self.pid}:{self.started}"

    def is_alive(self, beat: float) -> bool:
        """Whether the driver still works.

        Args:
            beat: seconds since 1970 at which it last said so; all that counts on another machine.
        """
        if self.host == os.uname().nodename:
            return _started(self.pid) == self.started
        return time.time() - beat < STALE_S


def _started(pid: int) -> str:
    """Start of a process as the kernel tells it; "" for one that is not there or a zombie."""
    try:
        after_name = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if after_name[0] in "ZX" else after_name[19]
