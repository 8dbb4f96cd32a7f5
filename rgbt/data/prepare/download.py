"""Read the files of a download, in folders or in zip archives.

Part of `rgbt.data.prepare`.
"""

from __future__ import annotations

import os
import re
import stat
import zipfile
import zlib
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from rgbt.checks import InputError

CHUNK = 2**20
"""Bytes read at a time."""

BROKEN = (OSError, zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError)
"""Exceptions of damaged, encrypted or unknown archives."""

ENCRYPTED = 1
"""Bit of the flags of a member."""


@dataclass(frozen=True)
class SourceFile:
    """A file of the download.

    Attributes:
        path: in the download, with "/"; an archive counts as a folder.
        size: bytes.
        file: the file, or the archive that contains it.
        archive: the open archive; None: a plain file.
        member: its name in the archive.
    """

    path: str
    size: int
    file: Path
    archive: zipfile.ZipFile | None = None
    member: str = ""

    def chunks(self) -> Iterator[bytes]:
        """Its bytes in pieces; InputError if they cannot be read."""
        try:
            is_plain = self.archive is None
            with self.file.open("rb") if is_plain else self.archive.open(self.member) as stream:  # type: ignore[union-attr]
                while chunk := stream.read(CHUNK):
                    yield chunk
        except BROKEN as error:
            raise InputError(
                f"{self} cannot be read ({error}); allow access, or download the file again."
            ) from error

    def lines(self) -> tuple[str, ...]:
        """Stripped lines that are not empty; InputError if it is not a text."""
        try:
            text = b"".join(self.chunks()).decode("utf-8-sig")
        except UnicodeDecodeError as error:
            raise InputError(f"{self}: expected a list in UTF-8, one name per line.") from error
        return tuple(line.strip() for line in text.splitlines() if line.strip())

    def __str__(self) -> str:
        return str(self.file) if self.archive is None else f"{self.member} of {self.file}"


class SourceFiles:
    """All files of a download, listed once. A context that closes archives at its end.

    Hidden files and folders of other systems (__MACOSX) are left out. A file in a folder has
    precedence over one of the same path in an archive.

    Args:
        path: a folder, or a zip archive.
        key: name of the argument, for messages.
        archives: pattern of the names of archives that are opened inside a folder.

    Attributes:
        path: of the download.
        key: of the argument.
        entries: path -> file, sorted.

    Raises:
        InputError: the path does not exist, is neither a folder nor a complete archive, or an
            archive contains a path outside the folder into which it is unpacked.
    """

    def __init__(self, path: Path, key: str, archives: str = r"$^") -> None:
        self.path = path
        self.key = key
        self._opened = ExitStack()
        self._found: dict[str, SourceFile] = {}
        if path.is_dir():
            self._add_folder(path, re.compile(archives, re.IGNORECASE))
        elif path.is_file():
            self._add_archive(path, "")
        else:
            raise InputError(
                f"{key}: '{path}' does not exist; give the downloaded archive, or the folder into "
                "which it was unpacked."
            )
        self.entries = dict(sorted(self._found.items()))

    def __enter__(self) -> SourceFiles:
        return self

    def __exit__(self, *error: object) -> None:
        self._opened.close()

    def folders(self) -> frozenset[str]:
        """Every folder that holds something, "" for the download itself."""
        parents = {parent for path in self.entries for parent in PurePosixPath(path).parents}
        return frozenset("" if str(parent) == "." else str(parent) for parent in parents)

    def _add_folder(self, root: Path, archives: re.Pattern[str]) -> None:
        """Every file below `root`; links to folders are followed unless they lead back up."""

        def stop(error: OSError) -> None:
            raise InputError(
                f"{self.key}: {error.filename} cannot be listed ({error.strerror}); allow access, "
                "or give another folder."
            ) from error

        packed = []
        for folder, subfolders, names in os.walk(root, onerror=stop, followlinks=True):
            here = Path(folder)
            subfolders[:] = sorted(
                name for name in subfolders if not (_is_hidden(name) or _leads_back(here / name))
            )
            files = [here / name for name in names if not _is_hidden(name)]
            for file in (file for file in files if file.is_file()):
                relative = file.relative_to(root).as_posix()
                self._found[relative] = SourceFile(relative, file.stat().st_size, file)
                if archives.fullmatch(file.name):
                    packed.append(file)
        for file in packed:
            parent = file.relative_to(root).parent.as_posix()
            self._add_archive(file, "" if parent == "." else f"{parent}/")

    def _add_archive(self, file: Path, parent: str) -> None:
        """List an archive as if unpacked into a folder of its own name in `parent`."""
        try:
            archive = self._opened.enter_context(zipfile.ZipFile(file))
            members = archive.infolist()
        except BROKEN as error:
            raise InputError(
                f"{self.key}: {file} is not a complete zip archive ({error}); download it again, "
                "or give the folder into which it was unpacked."
            ) from error
        paths = {member.filename.replace("\\", "/"): member for member in members}
        for path, member in paths.items():
            if path.startswith("/") or ":" in path.partition("/")[0] or ".." in path.split("/"):
                raise InputError(
                    f"{self.key}: {file} holds '{member.filename}', which is outside the folder "
                    "into which it is unpacked. This is not the original archive; download it "
                    "again."
                )
            if member.flag_bits & ENCRYPTED:
                raise InputError(f"{self.key}: {file} is encrypted; unpack it and give the folder.")
        tops = {path.partition("/")[0] for path in paths}
        own = parent if tops <= {file.stem} else f"{parent}{file.stem}/"
        for path, member in paths.items():
            is_link = stat.S_ISLNK(member.external_attr >> 16)
            if not (member.is_dir() or is_link or _is_hidden(path)):
                entry = SourceFile(own + path, member.file_size, file, archive, member.filename)
                self._found.setdefault(entry.path, entry)


def _leads_back(path: Path) -> bool:
    return path.is_symlink() and path.parent.resolve().is_relative_to(path.resolve())


def _is_hidden(path: str) -> bool:
    return any(part.startswith(".") or part == "__MACOSX" for part in path.split("/"))
