"""Read and write compressed files of arrays that name their kind: counts, maps, statistics.

A file is a zip archive of arrays in NumPy's format; their kinds and shapes are checked against the
kind of file.
"""

from __future__ import annotations

import hashlib
import os
import re
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import replacing

FORMAT, DIGEST = "format", "digest"
"""Members of every archive: its mark, and the SHA-256 of all others (`_digest`)."""

COMPRESSIONS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
Header: TypeAlias = tuple[str, tuple[int, ...]]
"""`numpy.dtype.kind` and shape of an array."""

DAMAGED = (
    *(ValueError, TypeError, KeyError, OSError, EOFError, OverflowError, struct.error, zlib.error),
    *(zipfile.BadZipFile, NotImplementedError, RuntimeError, MemoryError, tokenize.TokenError),
)
"""What `zipfile` and NumPy raise on damaged files; RuntimeError: an encrypted member."""


@dataclass(frozen=True)
class Archive:
    """A kind of file.

    Attributes:
        mark: written into every file; another number in it means another layout.
        what: is in it, for messages: "counts".
        advice: how such a file is made.
        members: name -> kinds of numbers (`numpy.dtype.kind`) and sizes by letter: "iu N R K K".
            Equal letters are equal sizes, digits are sizes themselves; a name that ends in "/"
            means all that begin so.
        optional: names of members that files of earlier versions lack.
    """

    mark: str
    what: str
    advice: str
    members: Mapping[str, str]
    optional: tuple[str, ...] = ()

    def save(self, path: Path, values: Mapping[str, Any]) -> None:
        """Write arrays as one whole file."""
        arrays: dict[str, Any] = {FORMAT: np.array(self.mark)}
        arrays |= {name: np.asanyarray(value) for name, value in values.items()}
        arrays[DIGEST] = np.array(_digest(arrays))
        with replacing(path) as file:
            np.savez_compressed(file, **arrays)

    def load(self, path: Path) -> dict[str, Any]:
        """What `save` wrote, by name; nothing in the file is executed.

        Raises:
            InputError: no such file, one that may not be read or is damaged, or another kind of
                file.
        """
        if not path.is_file():
            raise InputError(f"the file of {self.what} '{path}' does not exist; {self.advice}.")
        if not os.access(path, os.R_OK):
            raise InputError(f"'{path}' cannot be read: permission denied; change its permissions.")
        with self.refusing(path), zipfile.ZipFile(path) as archive:
            return self._read(archive, path)

    @contextmanager
    def refusing(self, path: Path) -> Iterator[None]:
        """Turn errors about a damaged file into an InputError with advice."""
        try:
            yield
        except InputError:
            raise
        except DAMAGED as error:
            raise InputError(
                f"'{path}' is not a readable file of {self.what} ({one_line(error)}); "
                f"{self.advice}."
            ) from error

    def _read(self, archive: zipfile.ZipFile, path: Path) -> dict[str, NDArray[Any]]:
        values = _arrays(archive)
        mark = one_line(values[FORMAT]) if FORMAT in values else "none"
        if mark != self.mark:
            raise InputError(
                f"'{path}' is not a file of {self.what}: expected the mark '{self.mark}', got "
                f"'{mark}'; {self.advice}."
            )
        self._check_members({name: (a.dtype.kind, a.shape) for name, a in values.items()})
        stored = values.pop(DIGEST, None)
        if stored is not None and str(stored) != _digest(values):
            raise ValueError("its content does not match its digest")
        return values

    def _check_members(self, headers: Mapping[str, Header]) -> None:
        missing = [
            name
            for name in self.members
            if name not in (*headers, *self.optional) and not name.endswith("/")
        ]
        if missing:
            raise ValueError(f"'{missing[0]}' is missing")
        members = {FORMAT: "U", DIGEST: "U", **self.members}
        sizes: dict[str, int] = {}
        for name, (kind, shape) in headers.items():
            group = re.sub("/.*", "/", name)
            kinds, *letters = members.get(group, "").split() or [""]
            fits = kind in kinds and len(shape) == len(letters)
            for letter, size in zip(letters, shape, strict=False):
                fits &= size == (int(letter) if letter.isdecimal() else sizes.get(letter, size))
                sizes[letter] = size
            if not fits:
                raise ValueError(f"'{name}' has the unexpected shape {shape}")


def _arrays(archive: zipfile.ZipFile) -> dict[str, NDArray[Any]]:
    """The arrays by name; nothing in them is executed."""
    arrays: dict[str, NDArray[Any]] = {}
    for entry in archive.infolist():
        name = entry.filename.removesuffix(".npy")
        is_ours = entry.filename == f"{name}.npy" and entry.compress_type in COMPRESSIONS
        if name in arrays or not is_ours:
            raise ValueError("its directory is damaged")
        with archive.open(entry) as member:
            arrays[name] = np.lib.format.read_array(member, allow_pickle=False)
            if member.read(1):  # the checksum is compared at the end of a member
                raise ValueError(f"'{name}' is longer than its header announces")
    return arrays


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 in hexadecimal over names, types, shapes and values."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
