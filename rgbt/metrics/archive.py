"""One compressed file of arrays that says what it is: counts, pixel maps, statistics."""

from __future__ import annotations

import os
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rgbt.checks import InputError


@dataclass(frozen=True)
class Archive:
    """A kind of file.

    Attributes:
        mark: written into every file; another number in it means another layout.
        what: is in it, for messages: "counts".
        advice: how such a file is made.
    """

    mark: str
    what: str
    advice: str

    def save(self, path: Path, values: Mapping[str, Any]) -> None:
        """Write arrays under a temporary name, then rename: never half a file."""
        partial = path.with_name(f"{path.name}.{os.getpid()}.partial")
        try:
            with partial.open("wb") as stream:
                np.savez_compressed(stream, **{"format": np.array(self.mark), **values})
                stream.flush()
                os.fsync(stream.fileno())
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)

    def load(self, path: Path) -> dict[str, Any]:
        """What `save` wrote, by name; nothing in the file is executed.

        Raises:
            InputError: no such file, one that may not be read, or another kind of file.
        """
        if not path.is_file():
            raise InputError(f"there is no file of {self.what} '{path}'; {self.advice}.")
        if not os.access(path, os.R_OK):
            raise InputError(f"'{path}' may not be read; change its permissions.")
        try:
            with np.load(path, allow_pickle=False) as stored:
                values = {key: stored[key] for key in stored.files}
        # TypeError: a lone array of NumPy's other format opens, but is no archive.
        except (ValueError, TypeError, OSError, EOFError, zipfile.BadZipFile, zlib.error) as error:
            raise InputError(
                f"'{path}' is not a readable file of {self.what}; {self.advice}."
            ) from error
        if str(values.get("format")) != self.mark:
            raise InputError(
                f"'{path}' is no file of {self.what}: expected the mark '{self.mark}', got "
                f"'{values.get('format')}'; {self.advice}."
            )
        return values
