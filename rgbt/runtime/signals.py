"""Handle the signals that end a command, at once or between two training steps.

Ctrl-C, SIGHUP (a terminal that is closed) and SIGTERM (a cluster that takes its machine away) raise
`Stopped`. Inside `deferred` they are only noted, so that no step and no file stays incomplete;
inside `at_once` within it they are handled at once again.
"""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType

WORDS = {signal.SIGINT: "interrupted", signal.SIGTERM: "stopped by SIGTERM"}
HANGUP = getattr(signal, "SIGHUP", None)  # POSIX: the terminal was closed
if HANGUP is not None:
    WORDS[HANGUP] = "stopped by SIGHUP"


class Stopped(KeyboardInterrupt):
    """Raised for the signal `number`; `step` is that of the checkpoint saved for it, or None."""

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        self.code = 128 + number
        self.step: int | None = None

    def __str__(self) -> str:
        saved = "" if self.step is None else f" at step {self.step}, and the checkpoint is saved"
        return f"{WORDS[signal.Signals(self.number)]}{saved}; rerun the command to resume."


# Number of the first signal that came (0: none), and whether signals wait.
_number = 0
_is_deferred = False


@contextmanager
def answered() -> Iterator[None]:
    """Handle the signals of `WORDS`, except those that the process was started to ignore (nohup).

    Clusters signal a process more than once: the first one counts. A second Ctrl-C stops at once.
    """
    process = os.getpid()
    terminals = [stream for stream in (1, 2) if os.isatty(stream)]

    def answer(number: int, frame: FrameType | None) -> None:
        del frame
        if os.getpid() != process:  # a forked process has nothing to clean up
            os._exit(128 + number)
        for stream in terminals if number == HANGUP else ():  # closed: every write fails
            with Path(os.devnull).open("w") as nowhere:
                os.dup2(nowhere.fileno(), stream)
        global _number
        if _number == 0:
            _number = number
            if not _is_deferred:
                raise Stopped(number)
        elif number == signal.SIGINT:
            raise KeyboardInterrupt

    global _number, _is_deferred
    outer = _number, _is_deferred
    _number, _is_deferred = 0, False
    before = {number: signal.getsignal(number) for number in WORDS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, answer)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _number, _is_deferred = outer


@contextmanager
def ending_command() -> Iterator[None]:
    """Turn an error after a signal into `Stopped`: a library left halfway may raise one."""
    try:
        yield
    except Exception:
        raise_noted()
        raise


@contextmanager
def deferred() -> Iterator[None]:
    """Note signals; the one that came is raised on leaving, or by `at_once`."""
    global _is_deferred
    before, _is_deferred = _is_deferred, True
    try:
        with ending_command():  # processes that were started just now may end with an error
            yield
    finally:
        _is_deferred = before
    if not before:
        raise_noted()


@contextmanager
def at_once() -> Iterator[None]:
    """Inside `deferred`: raise the signal that came, and others when they come."""
    global _is_deferred
    before, _is_deferred = _is_deferred, False
    try:
        raise_noted()
        yield
    finally:
        _is_deferred = before


def noted() -> int:
    """Return the number of the signal that came; 0: none."""
    return _number


def raise_noted(number: int | None = None) -> None:
    """Raise `Stopped` for the signal that came, or for `number`, which another process noted."""
    global _number
    number = _number if number is None else number
    if number:
        _number = number
        raise Stopped(number)
