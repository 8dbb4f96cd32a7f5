"""Prepare a process that trains a run together with others: its end, its signals and its output.

Process 0 answers signals and prints. The others ignore signals, because they must finish the step
of process 0 with it, and print only the errors that are theirs alone.
"""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from rgbt.checks import InputError
from rgbt.runtime.group import SUPERVISOR, Group, group_from_environment
from rgbt.runtime.signals import WORDS

LOST = 75
"""Exit code of a process that ends because another one of its run did; only its supervisor sees it,
and reports the process that ended first."""

PR_SET_PDEATHSIG = 1


class _Output:
    """Where the errors of this process go, and whether they are written."""

    errors: TextIO | None = None
    prefix = ""
    is_silent = False


def end_with_supervisor() -> None:
    """Let the system end this process when the one that supervises it has ended."""
    supervisor = os.environ.get(SUPERVISOR, "")
    if not supervisor.isdecimal():
        return
    with suppress(OSError, AttributeError):  # not Linux: the supervisor still ends it in order
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != int(supervisor):  # it ended before this call
        os._exit(LOST)


@contextmanager
def taking_part() -> Iterator[None]:
    """Begin a command that may be one of several processes of a run; see the module."""
    end_with_supervisor()
    try:
        group = group_from_environment()
    except InputError:
        group = None  # reported by the command
    if group is None or group.rank == 0:
        yield
        return
    with _quiet(group):
        yield


@contextmanager
def _quiet(group: Group) -> Iterator[None]:
    handlers = {number: signal.signal(number, signal.SIG_IGN) for number in WORDS}
    streams = sys.stdout, sys.stderr
    _Output.errors, _Output.prefix = sys.stderr, f"{group.title}: "
    # Before the processes are connected, they fail alike: one message of a machine is enough.
    _Output.is_silent = not group.is_supervised and group.local_rank > 0

    with Path(os.devnull).open("w", encoding="utf-8") as nowhere:
        sys.stdout = sys.stderr = nowhere
        try:
            yield
        finally:
            # Python writes an exception that nobody handles after this.
            sys.stdout, sys.stderr = streams
            _Output.errors, _Output.prefix, _Output.is_silent = None, "", False
            for number, handler in handlers.items():
                signal.signal(number, handler)


def report_errors() -> None:
    """From now on report the errors of this process: the processes are connected."""
    _Output.is_silent = False


def write_error(sentence: str) -> None:
    """Write a message about the end of the command on stderr, with the number of the process."""
    if not _Output.is_silent:
        stream = _Output.errors or sys.stderr
        stream.write(f"rgbt: {_Output.prefix}{sentence}\n")
        stream.flush()
