"""Write files atomically, and hold locks that end with their process."""

from __future__ import annotations

import fcntl
import os
import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

POLL_S = 0.1
"""Seconds between two attempts to take a lock."""

LEFT_BEHIND = re.compile(
    r"\.(?:last|last_previous|best)\.pt\.partial|\.counts_\w+\.npz\.partial"
    r"|\..+\.(\d+)|.+\.(\d+)\.partial"
)
"""Temporary names in a run folder, of earlier versions too, with the process that wrote them. Those
without one are written by the holder of the run's lock alone."""

STALE_S = 3600.0
"""Age above which a temporary file is treated as abandoned."""

_held: set[int] = set()
"""Descriptors of locks of this process; loader workers forked from it must not keep them."""


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or a machine that crashes, sees the old or the new content."""
    with replacing(path) as file:
        file.write(content)


@contextmanager
def replacing(path: Path) -> Iterator[BinaryIO]:
    """A file to write, which replaces `path` when the block ends without an exception.

    Temporary name in the same folder, fsync, rename, fsync of the folder.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        with temporary.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        temporary.replace(path)
    finally:
        temporary.unlink(missing_ok=True)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def remove_left_behind(folder: Path, writer: int | None) -> None:
    """Remove temporary files that a killed process left in a run folder.

    Files that another process may be writing now, such as an evaluation, are left alone.

    Args:
        folder: of the run, whose lock is held.
        writer: the process that held the lock before; None: not known.
    """
    for path in folder.rglob("*"):
        found = LEFT_BEHIND.fullmatch(path.name)
        if found is None:
            continue
        number = found.group(1) or found.group(2)
        is_ours = number is None or int(number) in (writer, os.getpid())
        if is_ours or time.time() - path.stat().st_mtime > STALE_S:
            path.unlink()


def holder_of(path: Path) -> int | None:
    """Number of the process that held the lock `path` last; None where it does not say."""
    found = re.match(r"process (\d+) on ", path.read_text()) if path.exists() else None
    return None if found is None else int(found.group(1))


@contextmanager
def holding(path: Path, *, wait_s: float = 0.0) -> Iterator[str | None]:
    """Hold an exclusive lock on the file `path`, which is made if needed and never removed.

    The operating system frees the lock when this process ends, however it ends.

    Args:
        path: the lock's file; its text names the holder.
        wait_s: seconds to wait for a lock that another process holds, >= 0; `math.inf` for ever.

    Yields:
        None while the lock is held by us; otherwise who holds it ("process 12 on host").
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    _held.add(descriptor)
    try:
        holder = _lock(descriptor, time.monotonic() + wait_s)
        yield holder
    finally:
        _held.discard(descriptor)
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Whether some process, this one included, holds the lock `path`."""
    if not path.exists():
        return False
    with path.open() as file:
        try:
            # Shared: two processes that ask at the same time do not take each other for a holder.
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            return True
    return False


def _lock(descriptor: int, deadline: float) -> str | None:
    """None once the lock is ours; who holds it where it is not until `deadline`."""
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            # Polled: a wait inside flock has no limit, and a stopped process never lets go.
            if time.monotonic() >= deadline:
                return os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
            time.sleep(POLL_S)
        else:
            break
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"process {os.getpid()} on {os.uname().nodename}".encode(), 0)
    return None


def _close_in_child() -> None:
    # A forked loader worker outlives a killed parent by seconds. With the parent's descriptor it
    # would keep the lock, and the command that resumes the run would be refused.
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_close_in_child)
