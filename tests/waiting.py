"""Waiting for what another process does."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import psutil

DEADLINE_S = 180.0
"""Generous: the machine may be busy. Nothing waits for it but a test that fails."""


def until(condition: Callable[[], Any], what: str, poll_s: float = 0.01) -> Any:
    """What `condition` answers once it is true; fails after `DEADLINE_S`."""
    end = time.monotonic() + DEADLINE_S
    while time.monotonic() < end:
        found = condition()
        if found:
            return found
        time.sleep(poll_s)
    raise AssertionError(f"waited {DEADLINE_S:g} s in vain for {what}")


def is_alive(pid: int) -> bool:
    """Whether a process of this machine runs; a zombie does not."""
    try:
        return psutil.Process(pid).status() not in (psutil.STATUS_ZOMBIE, psutil.STATUS_DEAD)
    except psutil.NoSuchProcess:
        return False
