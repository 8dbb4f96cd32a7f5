"""Write planned files to a temporary folder, which is renamed when it is complete.

Part of `rgbt.data.prepare`.
"""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from rgbt.checks import InputError
from rgbt.data.prepare.download import SourceFile

PLAN = ".prepare.json"
"""File in the new folder that describes its source."""

SPARE = 2**24
"""Bytes that must stay free on the disk."""


class Item(NamedTuple):
    """A file to be written.

    Attributes:
        target: path in the new folder, with "/".
        content: a file of the download, or its bytes.
    """

    target: str
    content: SourceFile | bytes

    @property
    def size(self) -> int:
        """Bytes."""
        return len(self.content) if isinstance(self.content, bytes) else self.content.size

    def chunks(self) -> Iterator[bytes]:
        """Its bytes in pieces."""
        return iter((self.content,)) if isinstance(self.content, bytes) else self.content.chunks()

    def is_at(self, path: Path) -> bool:
        """Whether `path` holds these bytes; all are compared."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        with path.open("rb") as file:
            return all(file.read(len(chunk)) == chunk for chunk in self.chunks())


def check_out(out: Path, sources: tuple[Path, ...]) -> None:
    """Refuse a new folder that is inside one of `sources`."""
    for source in sources:
        if out.resolve().is_relative_to(source.resolve()):
            raise InputError(
                f"out: {out} is inside {source}, which must not change. Choose a folder outside it."
            )


def copy(
    items: list[Item], out: Path, plan: dict[str, str], advance: Callable[[int], object]
) -> None:
    """Make `out` of `items`, which have different targets, or compare it with them.

    Files are written into a temporary folder beside `out`, which is renamed when all of them are
    complete. Files of an interrupted command are removed.

    Args:
        items: files to write.
        out: new folder; where it holds files already, these must be the same.
        plan: what it is made from; written into it.
        advance: called with the bytes of every file that was written or compared.

    Raises:
        InputError: `out` holds something else, is being prepared by another process or cannot be
            written; too little space; or a file of the download that cannot be read or has another
            size than listed.
    """
    if out.is_file() or (out.is_dir() and any(out.iterdir())):
        _compare(items, out, advance)
        return
    try:
        with _temporary(out) as folder:
            _check_space(items, folder)
            for item in items:
                _write(item, folder / item.target)
                advance(item.size)
            (folder / PLAN).write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8")
            folder.replace(out)
    except OSError as error:
        raise InputError(
            f"out: cannot write {error.filename or out} ({error.strerror or error}); free some "
            "space, or choose a writable folder."
        ) from error


def _compare(items: list[Item], out: Path, advance: Callable[[int], object]) -> None:
    """Refuse other bytes than those of `items`, and further files, which a reader would use."""
    others = []
    for item in items:
        if not item.is_at(out / item.target):
            others.append(out / item.target)
        advance(item.size)
    targets = {out / item.target for item in items}
    folders = {path.parent for path in targets} - {out}
    others += [
        path
        for folder in folders
        if folder.is_dir()
        for path in folder.iterdir()
        if path.is_file() and not path.name.startswith(".") and path not in targets
    ]
    if others:
        raise InputError(
            f"out: {out} is not empty and differs from the download in {len(others)} files; the "
            f"first is {min(others)}. Remove the folder, or choose another one."
        )


@contextmanager
def _temporary(out: Path) -> Iterator[Path]:
    """An empty folder beside `out`, removed at the end unless it was renamed.

    A lock on it keeps a second process away; it ends with this process.
    """
    folder = out.absolute().with_name(f".{out.name}.preparing")
    folder.mkdir(parents=True, exist_ok=True)
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        for path in folder.iterdir():
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        yield folder
    except BlockingIOError as error:
        raise InputError(
            f"out: another process is preparing {out}; wait for it, or choose another folder."
        ) from error
    except BaseException:
        shutil.rmtree(folder)
        raise
    finally:
        os.close(descriptor)


def _check_space(items: list[Item], folder: Path) -> None:
    needed, free = sum(item.size for item in items) + SPARE, shutil.disk_usage(folder).free
    if needed > free:
        raise InputError(
            f"out: {needed / 1e9:.2f} GB must be copied to {folder.parent}, but its disk has "
            f"{free / 1e9:.2f} GB left. Free some space, or choose a folder on another disk."
        )


def _write(item: Item, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    size = 0
    with path.open("xb") as file:
        for chunk in item.chunks():
            file.write(chunk)
            size += len(chunk)
    if size != item.size:
        raise InputError(
            f"{item.content!s} holds {size} bytes but {item.size} were listed. If the download is "
            "still in progress, rerun the command when it is complete."
        )
