"""Handle the signals that end a command, at once or between two training steps.

Ctrl-C and SIGHUP (a terminal that is closed) and SIGTERM (a cluster that takes its machine away)
raise `Stopped`. Inside `deferred` they are only noted, so that no step and no file stays
incomplete; inside `at_once` within it they are handled at once again.

A raised `Stopped` may get lost. Python drops what is raised while it frees an object (``__del__``,
a callback of a weak reference), C code may clear it, and a ``finally`` of a library that is left
halfway may raise another error, which the library then handles. A timer therefore raises `Stopped`
again until it is handled.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType

WORDS = {
    signal.SIGINT: "interrupted",
    signal.SIGTERM: "stopped by SIGTERM",
    signal.SIGHUP: "stopped by SIGHUP",
}


SOON = 0.05
"""Seconds until a `Stopped` that Python reported as dropped is raised again."""

AGAIN = 1.0
"""Seconds between two checks whether a `Stopped` was dropped without a report."""


class Stopped(KeyboardInterrupt):
    """Raised for the first signal that ends a command, when no step or file is incomplete.

    Attributes:
        number: of the signal.
        step: of the checkpoint that was written for it; None where there was nothing to save.
    """

    def __init__(self, number: int) -> None:
        super().__init__()
        self.number = number
        self.step: int | None = None

    @property
    def code(self) -> int:
        """Exit code of the command."""
        return 128 + self.number

    def __str__(self) -> str:
        saved = "" if self.step is None else f" at step {self.step}, and the checkpoint is saved"
        return f"{WORDS[signal.Signals(self.number)]}{saved}; rerun the command to resume."


@dataclass
class _Signals:
    """The first signal that came (0: none), whether it was raised, waits, or has been handled."""

    number: int = 0
    is_raised: bool = False
    is_deferred: bool = False
    is_handled: bool = False


_signals = _Signals()


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
        if number == signal.SIGHUP:
            _leave(terminals)
        if _signals.number == 0:
            _signals.number = number
            if not _signals.is_deferred:
                _raise_noted()
        elif number == signal.SIGINT:
            raise KeyboardInterrupt

    global _signals
    outer, _signals = _signals, _Signals()
    before = {number: signal.getsignal(number) for number in WORDS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:
            signal.signal(number, answer)
    try:
        with _raised_again():
            yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _signals = outer


@contextmanager
def _raised_again() -> Iterator[None]:
    """Raise a `Stopped` that was dropped again, by a timer: no thread may start just there."""

    def note(dropped: sys.UnraisableHookArgs) -> None:
        if isinstance(dropped.exc_value, Stopped):
            _signals.is_raised = False
            signal.setitimer(signal.ITIMER_REAL, SOON, AGAIN)
        else:
            hook(dropped)

    def again(number: int, frame: FrameType | None) -> None:
        del number, frame
        if _signals.is_handled:
            return
        if _signals.is_raised and not _is_being_handled():
            _signals.is_raised = False
        if not _signals.is_deferred:
            _raise_noted()

    hook, alarm = sys.unraisablehook, signal.signal(signal.SIGALRM, again)
    sys.unraisablehook = note
    try:
        yield
    finally:
        sys.unraisablehook = hook
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, alarm)


def _is_being_handled() -> bool:
    """Whether an ``except``, a ``finally`` or an ``__exit__`` runs because of `Stopped`."""
    error = sys.exception()
    while error is not None and not isinstance(error, Stopped):
        error = error.__context__
    return error is not None


@contextmanager
def ending_command() -> Iterator[None]:
    """Turn any error after `Stopped` was raised into `Stopped`, which the caller handles.

    A library that is left halfway may raise an error of its own.
    """
    try:
        yield
    except Exception as error:
        if _signals.is_raised:
            raise Stopped(_signals.number) from error
        raise


def handled() -> None:
    """Do not raise the signal again: the command ends because of it."""
    _signals.is_handled = True


@contextmanager
def deferred() -> Iterator[None]:
    """Note signals; the one that came is raised on leaving, or by `at_once`.

    An error after it is taken for its consequence: processes that were started just now end.
    """
    before, _signals.is_deferred = _signals.is_deferred, True
    try:
        yield
    except Exception:
        _raise_noted()
        raise
    finally:
        _signals.is_deferred = before
    if not before:
        _raise_noted()


@contextmanager
def at_once() -> Iterator[None]:
    """Inside `deferred`: raise the signal that came, and others when they come.

    Raises:
        Stopped: a signal came.
    """
    before, _signals.is_deferred = _signals.is_deferred, False
    try:
        _raise_noted()
        yield
    finally:
        _signals.is_deferred = before


def _raise_noted() -> None:
    if _signals.number and not _signals.is_raised:
        _signals.is_raised = True
        signal.setitimer(signal.ITIMER_REAL, AGAIN, AGAIN)
        raise Stopped(_signals.number)


def _leave(terminals: list[int]) -> None:
    """Ignore output to a terminal that was closed."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in terminals:
        os.dup2(nowhere, stream)
    os.close(nowhere)
