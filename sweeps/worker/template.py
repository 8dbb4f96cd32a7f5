"""The process from which the runs of a command are forked; itself a fork of the command.

A command has imported torch, Hydra and MLflow before its first run starts. Its template inherits
them and imports the rest of rgbt while the command plans its points, so nothing is imported twice.
It is forked before the command opens a store, starts a thread or computes anything: connections and
the state of a run are never shared. It only waits, forks, and says how its processes ended.
"""

from __future__ import annotations

import gc
import importlib
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NoReturn

UNKNOWN = 255
"""Exit code of a process that ended after its template had, as in Python's fork server."""

Work = Callable[..., object]


class TemplateProcess:
    """A process that the template forked; like `multiprocessing.Process`."""

    def __init__(self, template: Template, pid: int) -> None:
        self.pid = pid
        self._template = template
        self._code: int | None = None

    @property
    def exitcode(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        if self._code is None:
            self._code = self._template.exit_code(self.pid)
        return self._code


class Template:
    """A waiting fork of this process.

    Args:
        modules: imported by the fork at once.
        imported: called in the fork after every import of modules.
    """

    def __init__(self, modules: Sequence[str], imported: Callable[[], None]) -> None:
        self._connection, theirs = multiprocessing.Pipe()
        # A run would write again what is buffered now.
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        self._pid = os.fork()
        if self._pid == 0:
            try:
                self._connection.close()
                _serve(theirs, modules, imported)
            except Exception as error:  # the answer to the first request
                theirs.send(OSError(f"{type(error).__name__}: {error}"))
            finally:  # never back into the copy of the command
                os._exit(1)
        theirs.close()

    def start(
        self, work: Work, arguments: Sequence[Any], modules: Sequence[str]
    ) -> TemplateProcess:
        """Call a function in a new process.

        Args:
            work: a function of a module.
            arguments: of the function.
            modules: imported by the template before it forks, if they are new.

        Raises:
            OSError: the template has ended, or cannot fork.
        """
        try:
            self._connection.send((work, tuple(arguments), tuple(modules)))
            answer = self._connection.recv()
        except (EOFError, ConnectionError) as error:
            raise OSError("the process that starts runs has ended") from error
        if isinstance(answer, OSError):
            raise answer
        return TemplateProcess(self, answer)

    def exit_code(self, pid: int) -> int | None:
        """The exit code of a process that was started; None while it runs."""
        try:
            self._connection.send(pid)
            code: int | None = self._connection.recv()
        except (EOFError, OSError):
            return None if _exists(pid) else UNKNOWN
        return code

    def close(self) -> None:
        """End the template; processes that it started continue."""
        self._connection.close()
        os.waitpid(self._pid, 0)


def _exists(pid: int) -> bool:
    """Whether a process runs; one that ended may remain where nobody collects its exit code."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    try:
        status = Path(f"/proc/{pid}/stat").read_text(encoding="utf-8", errors="replace")
    except OSError:  # no such folder on this system, or the process has just ended
        return not Path("/proc/self").exists()
    return status.rpartition(")")[2].split()[0] != "Z"


def _serve(
    connection: Connection, modules: Sequence[str], imported: Callable[[], None]
) -> NoReturn:
    """In the template: import, then fork one process per request until the command ends."""
    _forget_command()
    _import(modules)
    imported()
    # Objects of the template are no garbage of a run, and its collector need not visit them.
    gc.collect()
    gc.freeze()
    context = multiprocessing.get_context("fork")
    processes: dict[int, Any] = {}
    while True:
        try:
            request = connection.recv()
        except EOFError:
            os._exit(0)
        if isinstance(request, int):
            code = processes[request].exitcode
            if code is not None:
                del processes[request]
            connection.send(code)
            continue
        work, arguments, further = request
        if _import(further):
            imported()
        process = context.Process(target=_call, args=(connection, work, arguments))
        try:
            process.start()
        except OSError as error:
            connection.send(error)
            continue
        assert process.pid is not None, "a started process has a number"
        processes[process.pid] = process
        connection.send(process.pid)


def _call(connection: Connection, work: Work, arguments: Sequence[Any]) -> None:
    connection.close()
    work(*arguments)


def _forget_command() -> None:
    """Undo what the command has set for itself: signal handlers, terminal, Hydra's state."""
    from hydra.core.global_hydra import GlobalHydra

    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the command, which stops its runs
    for number in (signal.SIGTERM, signal.SIGHUP, signal.SIGALRM):
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, signal.SIG_DFL)
    sys.unraisablehook = sys.__unraisablehook__
    # Consoles that are made from now on write to the log of a run and not to a terminal.
    nowhere = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(nowhere, stream)
    os.close(nowhere)
    GlobalHydra.instance().clear()


def _import(modules: Sequence[str]) -> bool:
    """Import modules; whether one of them is new."""
    new = [name for name in modules if name not in sys.modules]
    for name in new:
        with suppress(ImportError):  # the run reports it, if it needs the module
            importlib.import_module(name)
    return bool(new)
