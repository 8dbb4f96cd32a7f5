"""Write files atomically, and hold locks that end with their process."""

from __future__ import annotations

import errno
import os
import platform
import re
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

from rgbt.checks import InputError, of_posix

# Seconds between two attempts to take a lock.
POLL_S = 0.1

# Temporary names with the process that wrote them (none: the holder of the run's lock), and the
# age in seconds above which such a file is abandoned.
LEFT_BEHIND, STALE_S = re.compile(r"\..+\.partial|\..+\.(\d+)"), 3600.0

# No space left, none within the quota, or above the largest size of a file that is allowed.
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)

# Descriptors of locks of this process; loader workers forked from it must not keep them.
_held: set[int] = set()


def cache_folder() -> Path:
    """Return the user's folder of what can be made again: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt."""
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "rgbt"


def check_writable(setting: str, folder: Path) -> None:
    """Refuse a folder in which nothing can be written or made, before any work; it stays as it is.

    `setting` is the word that named it, such as "runs_dir=/data", with which the InputError begins.
    """
    places = (folder.absolute(), *folder.absolute().parents)
    there = next(place for place in places if os.path.exists(place))  # noqa: PTH110 - raises nothing
    try:
        # Permissions do not tell: of a file system that is read-only or full, or of /proc.
        with tempfile.TemporaryDirectory(prefix=".", dir=there):
            pass
    except OSError as error:
        said = f"{setting}: cannot write in {there} ({error.strerror})"
        raise InputError(f"{said}; choose another folder.") from error


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file; a reader, or a machine that crashes, sees the old or the new content."""
    with replacing(path, lambda: len(content)) as file:
        file.write(content)


@contextmanager
def replacing(path: Path, size: Callable[[], int] | None = None) -> Iterator[BinaryIO]:
    """Open a file that replaces `path` when the block ends without an exception.

    OSError as of `naming_full_disk`; then `path` is as it was.
    """
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    with naming_full_disk(path, size):
        temporary.unlink(missing_ok=True)  # never write through a link of this name
        try:
            with temporary.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            temporary.replace(path)
        finally:
            temporary.unlink(missing_ok=True)
    if os.name == "nt":  # Windows opens no folder
        return
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


@contextmanager
def naming_full_disk(path: Path, size: Callable[[], int] | None = None) -> Iterator[None]:
    """Let an error of a full disk name the file that is written, and the bytes needed and free.

    Writers of archives raise errors of their own instead, with that of the disk as their context.
    `size`: computes the bytes that the file needs.
    """
    try:
        yield
    except Exception as error:
        cause: BaseException | None = error
        while cause is not None and getattr(cause, "errno", None) not in FULL:
            cause = cause.__cause__ or cause.__context__
        if not isinstance(cause, OSError):
            raise
        needed = f"{size() / 1e6:.2f} MB are needed, " if size else ""
        free = shutil.disk_usage(path.parent).free / 1e6
        room = f"{needed}{free:.2f} MB are free"
        said = f"{cause.strerror} ({room}); free some and rerun the command"
        raise OSError(cause.errno, said, str(path)) from error


def remove_left_behind(folder: Path, writer: int | None) -> None:
    """Remove temporary files that a killed process left in a run folder, whose lock is held.

    Files that another process than `writer`, which held the lock before, may be writing now are
    left alone.
    """
    for path in folder.rglob(".*"):
        found = LEFT_BEHIND.fullmatch(path.name)
        is_ours = found and (found[1] is None or int(found[1]) in (writer, os.getpid()))
        if is_ours or (found and time.time() - path.lstat().st_mtime > STALE_S):
            path.unlink()


def holder_of(path: Path) -> int | None:
    """Return the number of the process that held the lock `path` last; None: it does not say."""
    found = re.match(r"process (\d+) on ", path.read_text()) if path.is_file() else None
    return None if found is None else int(found[1])


@contextmanager
def holding(path: Path, *, wait_s: float = 0.0) -> Iterator[str | None]:
    """Hold an exclusive lock on the file `path`, which is made if needed and never removed.

    The operating system frees the lock when this process ends, however it ends. Waits `wait_s`
    seconds (`math.inf`: for ever) for a lock that another process holds.

    Yields:
        None while the lock is held by us; otherwise who holds it ("process 12 on host").
    """
    lock = _locks(path)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    _held.add(descriptor)
    deadline = time.monotonic() + wait_s
    try:
        # Polled: a wait inside flock has no limit, and a stopped process never lets go.
        while (
            not (is_ours := _take(lock, descriptor, lock.LOCK_EX)) and time.monotonic() < deadline
        ):
            time.sleep(POLL_S)
        if is_ours:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()} on {platform.node()}".encode(), 0)
            yield None
        else:
            yield os.pread(descriptor, 200, 0).decode(errors="replace") or "another process"
    finally:
        _held.discard(descriptor)
        os.close(descriptor)


def is_held(path: Path) -> bool:
    """Return whether some process, this one included, holds the lock `path`."""
    if not path.is_file():
        return False
    lock = _locks(path)
    with path.open() as file:  # shared: two that ask at once take no other for a holder
        return not _take(lock, file.fileno(), lock.LOCK_SH)


def _locks(path: Path) -> Any:
    return of_posix("fcntl", f"the lock {path}")


def _take(lock: Any, descriptor: int, kind: int) -> bool:
    try:
        lock.flock(descriptor, kind | lock.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def _close_in_child() -> None:
    # A forked loader worker outlives a killed parent by seconds. With the parent's descriptor it
    # would keep the lock, and the command that resumes the run would be refused.
    for descriptor in _held:
        os.close(descriptor)
    _held.clear()


if hasattr(os, "register_at_fork"):  # POSIX
    os.register_at_fork(after_in_child=_close_in_child)
