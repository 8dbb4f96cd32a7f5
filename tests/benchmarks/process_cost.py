"""CPU seconds of a command with all processes that it starts, also those that outlive their parent.

A fork server is no child of the process that waits for a run, so the kernel adds its time to nobody
who asks. This process adopts what a command leaves behind and waits for it (Linux).
"""

from __future__ import annotations

import ctypes
import os
import resource
import subprocess
import sys
from collections.abc import Mapping, Sequence

PR_SET_CHILD_SUBREAPER = 36
"""Request of ``prctl``: orphaned descendants become children of this process (linux/prctl.h)."""


def cpu_seconds(command: Sequence[str], environment: Mapping[str, str] | None = None) -> float:
    """CPU seconds, user and system, of ``python -m <command>`` and all its descendants.

    Args:
        command: module and its arguments.
        environment: variables of the command; None: those of this process.

    Raises:
        RuntimeError: the command failed, or the kernel does not hand over its descendants.
    """
    if ctypes.CDLL(None, use_errno=True).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0) != 0:
        raise RuntimeError(f"prctl: {os.strerror(ctypes.get_errno())}")
    before = _children()
    done = subprocess.run(
        [sys.executable, "-m", *command],
        env=None if environment is None else dict(environment),
        capture_output=True,
        text=True,
        check=False,
    )
    _wait_for_orphans()
    if done.returncode:
        raise RuntimeError(f"{' '.join(command)}: {done.stderr[-500:]}")
    return _children() - before


def _wait_for_orphans() -> None:
    while True:
        try:
            os.wait()
        except ChildProcessError:
            return


def _children() -> float:
    """CPU seconds of all processes for which this one has waited."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime
