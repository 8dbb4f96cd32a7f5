"""Files that are whole or absent, and locks that die with their process."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

_held: set[int] = set()
"""Descriptors of locks of this process; loader workers forked from it must not keep them."""


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file so that a reader, or a machine that crashes, sees the old or the new content.

    Temporary name in the same folder, fsync, rename, fsync of the folder.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with temporary.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    temporary.replace(path)
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextmanager
def holding(path: Path, *, wait: bool = False) -> Iterator[str | None]:
    """Hold an exclusive lock on the file `path`, which is made if needed and never removed.

    The operating system frees the lock when this process ends, however it ends.

    Args:
        path: the lock's file; it says in words who holds it.
        wait: wait for the lock instead of reporting who holds it.

    Yields:
        None while the lock is held by us; otherwise who holds it ("process 12 on host").
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    _held.add(descriptor)
    try:
        holder = _try_lock(descriptor, wait=wait)
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


def _try_lock(descriptor: int, *, wait: bool) -> str | None:
    """None if the lock is ours now, else who holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
    except BlockingIOError:
        return os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
    os.ftruncate(descriptor, 0)
    os.pwrite(descriptor, f"process {os.getpid()} on {os.uname().nodename}".encode(), 0)
    return None


def _close_in_child() -> None:
    # A forked loader worker outlives a killed parent by seconds; with the parent's descriptor it
    # would keep the lock, and the command that continues the run would be refused.
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


os.register_at_fork(after_in_child=_close_in_child)
