"""Read and write compressed files of arrays that name their kind and carry a digest."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, one_line
from rgbt.files.atomic import replacing
from rgbt.files.plain_files import disguise

# Bytes that the arrays of a file hold at most: a megabyte of zeros can stand for a gigabyte.
MAX_BYTES = 2**33
MAX_TEXT = 2**20  # of one text
FORMAT, DIGEST = "format", "digest"  # members of every file
T = TypeVar("T")


@dataclass(frozen=True)
class Archive:
    """A kind of file: the mark in it, what it holds ("counts"), and how such a file is made."""

    mark: str
    what: str
    advice: str

    def save(self, path: Path, values: Mapping[str, Any]) -> None:
        """Write arrays as one whole file."""
        arrays = {name: np.asanyarray(value) for name, value in values.items()}
        arrays[FORMAT] = np.array(self.mark)
        arrays[DIGEST] = np.array(_digest(arrays))
        with replacing(path) as file:
            np.savez_compressed(file, **arrays)

    def load(self, path: Path, build: Callable[[dict[str, Any]], T]) -> T:
        """Return what `build` makes of what `save` wrote; InputError: a damaged or other file."""
        if not path.is_file():
            raise InputError(f"the file of {self.what} '{path}' does not exist; {self.advice}.")
        try:
            with np.load(path, allow_pickle=False) as stored:
                size = sum(member.file_size for member in stored.zip.infolist())
                if size > MAX_BYTES:
                    raise ValueError(f"it holds {size / 2**30:.0f} GiB")
                arrays = {name: stored[name] for name in stored.files}
            if str(arrays.pop(DIGEST)) != _digest(arrays):
                raise ValueError("its content does not match its digest")
            if str(mark := arrays.pop(FORMAT)) != self.mark:
                raise ValueError(f"expected the mark '{self.mark}', got '{one_line(mark)}'")
            return build(arrays)
        except Exception as error:  # zipfile and NumPy raise anything on damaged bytes
            raise self._damaged(path, error) from error

    def read_text(self, path: Path, name: str, parse: Callable[[str], T]) -> T:
        """Return what `parse` makes of the text called `name` of a file; nothing else is read."""
        try:
            with np.load(path, allow_pickle=False) as stored:
                if stored.zip.getinfo(f"{name}.npy").file_size > MAX_TEXT:
                    raise ValueError(f"'{name}' is longer than {MAX_TEXT} bytes")
                return parse(str(stored[name]))
        except Exception as error:
            raise self._damaged(path, error) from error

    def _damaged(self, path: Path, error: Exception) -> InputError:
        said = disguise(path) or one_line(error)
        reason = f"is not a readable file of {self.what} ({said})"
        return InputError(f"'{path}' {reason}; {self.advice}.")


def _digest(arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 in hexadecimal over names, types, shapes and values."""
    digest = hashlib.sha256()
    for name, array in sorted(arrays.items()):
        digest.update(f"{name} {array.dtype.str} {array.shape}\n".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
