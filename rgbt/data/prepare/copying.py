"""Writes planned files, each one completely or not at all; an interrupted copy can be resumed.

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
from rgbt.files.budgets import read_json

PLAN = ".prepare.json"
"""File in the new folder with the arguments of the command, so that it can be resumed."""

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
        """Whether `path` holds these bytes; all are compared, as downloads may be repaired."""
        if not path.is_file() or path.stat().st_size != self.size:
            return False
        with path.open("rb") as file:
            return all(file.read(len(chunk)) == chunk for chunk in self.chunks())


def check_out(out: Path, sources: tuple[Path, ...], plan: dict[str, str]) -> None:
    """Refuse a folder that this command must not write to; nothing is written yet.

    Raises:
        InputError: `out` is inside one of `sources`, holds other files, or was begun with other
            arguments than those of `plan`.
    """
    for source in sources:
        if out.resolve().is_relative_to(source.resolve()):
            raise InputError(
                f"out: {out} is inside {source}, which is only read; name a folder outside it."
            )
    path = out / PLAN
    if not path.is_file():
        # A command that was killed at its start may leave an incomplete note.
        others = [each for each in _listed(out) if not each.name.startswith(PLAN)]
        if others:
            raise InputError(
                f"out: {out} is not empty and was not begun by this command; name another folder."
            )
        return
    try:
        begun = read_json(path, dict[str, str], "")
    except InputError:
        begun = None
    if begun != plan:
        raise InputError(
            f"out: {out} was begun with other arguments (see {path}); give the same arguments "
            "again, name another folder, or remove this one."
        )


@contextmanager
def claimed(out: Path, plan: dict[str, str]) -> Iterator[None]:
    """Make `out`, which passed `check_out`, write `plan` into it and lock it until the end.

    Raises:
        InputError: it is being written by another process, or cannot be written.
    """
    path = out / PLAN
    try:
        out.mkdir(parents=True, exist_ok=True)
        if not path.is_file():
            temporary = path.with_name(f"{PLAN}.{os.getpid()}")
            temporary.write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8")
            temporary.replace(path)
        with path.open("r+") as file:
            _lock(file.fileno(), out)
            yield
    except OSError as error:
        raise InputError(
            f"out: cannot write {error.filename or out} ({error.strerror or error}); free some "
            "space, or name a writable folder. Copied files are kept: the same command "
            "resumes."
        ) from error


def write_all(items: list[Item], out: Path, advance: Callable[[int], object]) -> None:
    """Write those of `items`, which have different targets, that do not exist yet in `out`.

    `advance` is called with the bytes of every file that exists or has been written.

    Raises:
        InputError: other files in the folders, too little space, or a file of the download that
            cannot be read or has another size than listed.
        OSError: `out` cannot be written.
    """
    _refuse_others(items, out)
    missing = []
    for item in items:
        if item.is_at(out / item.target):
            advance(item.size)
        else:
            missing.append(item)
    needed, free = sum(item.size for item in missing) + SPARE, shutil.disk_usage(out).free
    if needed > free:
        raise InputError(
            f"out: {needed / 1e9:.2f} GB are to be copied to {out}, but its disk has "
            f"{free / 1e9:.2f} GB left; free some space, or name a folder on another disk."
        )
    for item in missing:
        _write(item, out / item.target)
        advance(item.size)


def _refuse_others(items: list[Item], out: Path) -> None:
    """Refuse other files in the folders, which a reader would use as well."""
    targets = {item.target for item in items}
    folders = {out / target.rpartition("/")[0] for target in targets if "/" in target}
    found = (path for folder in sorted(folders) if folder.is_dir() for path in folder.iterdir())
    others = [
        path
        for path in found
        if path.is_file()
        and not path.name.startswith(".")
        and path.relative_to(out).as_posix() not in targets
    ]
    if others:
        raise InputError(
            f"out: {out} contains {len(others)} files that are not in the download, the first is "
            f"{min(others)}; remove them, or name another folder."
        )


def _listed(out: Path) -> list[Path]:
    """Content of a folder; of a file, the file itself."""
    return list(out.iterdir()) if out.is_dir() else [path for path in (out,) if path.exists()]


def _lock(descriptor: int, out: Path) -> None:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise InputError(
            f"out: another process is preparing {out}; wait for it, or name another folder."
        ) from error


def _write(item: Item, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    # Files are not flushed one by one, which takes longer than copying. After a power failure the
    # length, or the check that reads everything, shows the damage.
    temporary = path.with_name(f".{path.name}.part")
    size = 0
    with temporary.open("wb") as file:
        for chunk in item.chunks():
            file.write(chunk)
            size += len(chunk)
    if size != item.size:
        raise InputError(
            f"{item.content!s} holds {size} bytes but {item.size} were listed; is it still "
            "being downloaded? Repeat the command when it is complete."
        )
    temporary.replace(path)
