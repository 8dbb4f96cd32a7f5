"""Limit how much of a file is read, and check JSON and arrays before use."""

from __future__ import annotations

import json
import os
import stat
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, is_dataclass
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from rgbt.checks import InputError, one_line

if TYPE_CHECKING:
    from pydantic import TypeAdapter


@dataclass(frozen=True)
class Budget:
    """The limit on reading one kind of file, so that none fills the memory.

    Attributes:
        variable: environment variable that sets another limit.
        millions: the limit, in millions of `unit`.
        unit: what is counted, such as "bytes".
    """

    variable: str
    millions: int
    unit: str

    def check(self, path: Path, amount: int) -> None:
        """Raise InputError where reading `path` takes more than the limit.

        Args:
            path: the file, for the message.
            amount: number of units that its size or its header announces.
        """
        text = os.environ.get(self.variable, str(self.millions))
        if not text.isdecimal() or int(text) == 0:
            raise InputError(
                f"{self.variable}={text}: expected a whole number above 0, millions of {self.unit}."
            )
        if amount > 1_000_000 * int(text):
            raise InputError(
                f"{path} holds {amount / 1e6:,.0f} million {self.unit}, more than the limit of "
                f"{text} million. If it is the right file, set "
                f"{self.variable}={-(-amount // 1_000_000)}."
            )


PIXELS = Budget("RGBT_MAX_MEGAPIXELS", 100, "pixels")
"""Of an image. The largest of the supported data sets has 1.3 million; 100 take 800 MB at most."""

ARRAYS = Budget("RGBT_MAX_ARRAY_MB", 512, "bytes")
"""Of the arrays of a file. Counts of 10,000 images, 9 regions and 26 classes take 487 MB."""

CONTENT = Budget("RGBT_MAX_FILE_MB", 1000, "bytes")
"""Of an image file or a list. 100 million pixels of four 16-bit channels take 800 MB unpacked."""

TEXT = Budget("RGBT_MAX_JSON_MB", 32, "bytes")
"""Of a JSON file. 50,000 lines of metrics take 25 MB; the objects of 32 MB take up to 800 MB."""


def read_bytes(path: Path, budget: Budget, advice: str = "") -> bytes:
    """Every byte of a regular file of at most the size that `budget` allows.

    Args:
        path: of the file.
        budget: limit on its size.
        advice: what to do where `path` is no regular file.

    Raises:
        InputError: no regular file, or a larger one.
        OSError: it is missing or cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "not a regular file"
        raise InputError(f"{path} is {what}, expected a file{advice and f'; {advice}'}.")
    budget.check(path, status.st_size)
    return path.read_bytes()


SEAL = "crc32"
"""Key under which a mapping in a JSON file holds the check sum of all its other entries."""


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """`value` as JSON, with its checksum as the last entry (`SEAL`)."""
    plain = json.loads(json.dumps(value))
    return {**plain, SEAL: _check_sum(plain)}


def read_json(path: Path, form: Any, advice: str) -> Any:
    """The content of a JSON file as the type `form`, without its seal; see `parse_json`.

    Args:
        path: of the file, which exists.
        form: such as ``list[str]``, a TypedDict or a dataclass, of which an object is returned.
        advice: what to do with a damaged file.

    Raises:
        InputError: larger than `TEXT` allows, cannot be read, or damaged.
    """
    try:
        return parse_json(read_bytes(path, TEXT), form)
    except (ValueError, OSError) as error:
        if isinstance(error, InputError):
            raise
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise InputError(f"{path} is damaged ({one_line(reason)}); {advice}.") from error


def parse_json(text: bytes | str, form: Any) -> Any:
    """The value of a JSON text.

    The seal of a mapping, and of each mapping of a list, is compared and removed. Older files have
    no seal and only the keys of `form`.

    Raises:
        ValueError: no JSON in UTF-8, another type than `form`, or another check sum.
    """
    import pydantic
    from typing_extensions import is_typeddict

    try:
        found = json.loads(text)
        values = found if isinstance(found, list) else [found]
        are_sealed = all([_unseal(value) for value in values])
        value = found
        if isinstance(form, type) and is_dataclass(form):  # made of JSON alone when strict
            value = _adapter(form).validate_json(json.dumps(found), strict=True)
        else:
            _adapter(form).validate_python(found, strict=True)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}".removeprefix(": ")) from error
    has_keys = is_typeddict(form) or is_dataclass(form)
    strange = set(found) - set(form.__annotations__) if has_keys else set()
    if strange and not are_sealed:
        raise ValueError(f"unknown key '{min(strange)}'")
    return value


def _unseal(value: Any) -> bool:
    """Whether a value had a seal, which is removed in place."""
    if not isinstance(value, dict) or SEAL not in value:
        return False
    if value.pop(SEAL) != _check_sum(value):
        raise ValueError("it does not match its checksum")
    return True


def _check_sum(plain: Mapping[str, Any]) -> str:
    return f"{zlib.crc32(json.dumps(plain, sort_keys=True).encode()):08x}"


@cache
def _adapter(form: Any) -> TypeAdapter[Any]:
    from pydantic import TypeAdapter

    return TypeAdapter(form)


def check_array(file: IO[bytes], size: int) -> tuple[str, tuple[int, ...]]:
    """Check the header of an array in NumPy's format before anything is allocated for it.

    Args:
        file: at the beginning of the array; afterwards behind its header.
        size: bytes of header and values together.

    Returns:
        kind of its numbers (`numpy.dtype.kind`), and shape.

    Raises:
        ValueError: no array, one of Python objects, or one of another size than its header says.
    """
    import math
    import tokenize

    from numpy.lib import format as npy

    version = npy.read_magic(file)
    read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}.get(version)
    if read is None:
        raise ValueError(f"arrays of version {version} are not supported")
    try:
        shape, _, dtype = read(file)
    except (SyntaxError, TypeError, tokenize.TokenError, RecursionError) as error:
        raise ValueError("its header is damaged") from error
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not supported")
    wanted = math.prod(shape) * dtype.itemsize
    if any(length < 0 for length in shape) or wanted != size - file.tell():
        raise ValueError(f"its header announces {wanted} bytes, but it has {size - file.tell()}")
    return dtype.kind, tuple(shape)
