"""Start the processes of one run on this machine, and wait for them.

The command becomes a supervisor: it trains nothing, passes signals to process 0, and ends the
others when process 0 has ended or one of them failed. Its exit code is that of the process that
failed first. torch is not imported here.
"""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import IO

from rgbt.config.plain_command import say
from rgbt.runtime.group import SUPERVISOR
from rgbt.runtime.member import LOST
from rgbt.runtime.signals import WORDS

COMMAND = ("-m", "rgbt.run")
POLL_S = 0.05
GRACE_S = 10.0
"""Time in which the other processes may end by themselves after one has ended, in seconds."""

LOOPBACK = "lo"


@dataclass(frozen=True)
class _Member:
    """One of the processes; what all but process 0 write is kept in a file."""

    rank: int
    process: subprocess.Popen[bytes]
    output: IO[bytes] | None

    @property
    def code(self) -> int | None:
        """Its exit code as a shell shows it, 128 + number of a signal; None while it runs."""
        code = self.process.poll()
        return code if code is None or code >= 0 else 128 - code


def launch(num_processes: int, words: Sequence[str]) -> int:
    """Run ``rgbt run`` with these words in so many processes; returns its exit code.

    Args:
        num_processes: >= 2.
        words: arguments of the command.
    """
    with ExitStack() as opened:
        members: list[_Member] = []
        opened.enter_context(_passing_signals(members))
        opened.callback(_end, members)
        port = _free_port()
        for rank in range(num_processes):
            # Progress and results are those of process 0.
            output = opened.enter_context(tempfile.TemporaryFile()) if rank else None
            members.append(_start(rank, num_processes, port, words, output))
        return _outcome(members)


def _start(
    rank: int, size: int, port: int, words: Sequence[str], output: IO[bytes] | None
) -> _Member:
    variables = {
        **{"RANK": str(rank), "LOCAL_RANK": str(rank), "NODE_RANK": "0"},
        **{"WORLD_SIZE": str(size), "LOCAL_WORLD_SIZE": str(size)},
        **{"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(port), SUPERVISOR: str(os.getpid())},
    }
    # Threads of one process that wait in a loop would take the cores of the others.
    preferred = {"OMP_WAIT_POLICY": "PASSIVE"}
    if any(name == LOOPBACK for _, name in socket.if_nameindex()):
        # Otherwise gloo looks up the name of this machine, which containers may not know.
        preferred["GLOO_SOCKET_IFNAME"] = LOOPBACK
    process = subprocess.Popen(
        [sys.executable, *COMMAND, *words],
        env={**preferred, **os.environ, **variables},
        stdin=subprocess.DEVNULL,
        stdout=output,
        stderr=output,
        # A terminal signals all processes of a session, but the others must finish the step.
        start_new_session=True,
    )
    return _Member(rank, process, output)


def _outcome(members: Sequence[_Member]) -> int:
    """Wait until the run has ended; its exit code."""
    first, others = members[0], members[1:]
    while first.code is None and not any(member.code for member in others):
        time.sleep(POLL_S)
    # An error that all have in common comes within moments; what a lost connection causes, too.
    deadline = time.monotonic() + GRACE_S
    while first.code is None and time.monotonic() < deadline:
        time.sleep(POLL_S)
    if first.code in (0, LOST):  # with LOST, the one that caused it may still be ending
        while any(member.code is None for member in members) and time.monotonic() < deadline:
            if any(member.code not in (None, 0, LOST) for member in others):
                break
            time.sleep(POLL_S)
    if first.code == 0:
        return 0
    if first.code not in (None, LOST):
        return _reported(first, len(members))
    failed = [member for member in others if member.code not in (None, 0, LOST)]
    return _reported(failed[0], len(members)) if failed else _reported(first, len(members))


def _reported(member: _Member, size: int) -> int:
    """The exit code of the process that failed; its message, if it is not written yet."""
    code = member.code
    if member.output is not None:
        member.output.seek(0)
        sys.stderr.write(member.output.read().decode(errors="replace"))
        sys.stderr.flush()
    resume = "rerun the command to resume from the last checkpoint."
    title = f"process {member.rank} of {size}"
    if code is None or code == LOST:
        return say(f"{title} lost the connection to the other processes; {resume}", 1)
    signals = {128 + each for each in signal.Signals} - {128 + number for number in WORDS}
    if member.process.returncode < 0 or code in signals:
        number = code - 128
        name = signal.Signals(number).name if number in set(signal.Signals) else f"signal {number}"
        hint = " (the system kills processes that use too much memory)" * (name == "SIGKILL")
        return say(f"{title} was stopped by {name}{hint}; {resume}", code)
    return code


@contextmanager
def _passing_signals(members: Sequence[_Member]) -> Iterator[None]:
    """Pass the signals that end a command to process 0, which saves its step and ends."""

    def forward(number: int, frame: FrameType | None) -> None:
        if not members:  # nothing has started
            handler = before[signal.Signals(number)]
            if not callable(handler):
                sys.exit(128 + number)
            handler(number, frame)
        elif members[0].process.returncode is None:
            members[0].process.send_signal(number)

    before = {number: signal.getsignal(number) for number in WORDS}
    for number, handler in before.items():
        if handler is not signal.SIG_IGN:  # nohup
            signal.signal(number, forward)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _end(members: Sequence[_Member]) -> None:
    for member in members:
        if member.process.poll() is None:
            member.process.kill()
    for member in members:
        member.process.wait()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
        return port
