"""One wording for bad input, ranges of settings as types, shape checks, budgets of files.

A constructor that a configuration names declares the range of each setting in its annotations:
``ratio: Share``, or ``block: Annotated[int, Interval(ge=1, le=480)]``. `rgbt.config` checks them.
"""

from __future__ import annotations

import difflib
import inspect
import json
import os
import re
import stat
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, TYPE_CHECKING, Annotated, Any

from annotated_types import Interval, Len, Predicate, doc

if TYPE_CHECKING:  # the command line answers --help without waiting for torch
    from pydantic import TypeAdapter
    from torch import Tensor


Text = Annotated[str, Len(1, 4096), Predicate(str.isprintable), doc("printable characters")]
"""A name, a path or a pattern: an empty one would be read as the current folder."""

Share = Annotated[float, Interval(ge=0, le=1)]
"""A share of something, or a probability."""

ShareBelowOne = Annotated[float, Interval(ge=0, lt=1)]
"""A share that leaves something: a dropout rate, a momentum."""

NonNegative = Annotated[float, Interval(ge=0, le=1e6)]
"""A weight or a factor; 0 leaves out what it weighs."""

Positive = Annotated[float, Interval(gt=0, le=1e6)]
"""A factor, a norm or a length that cannot be 0."""

Power = Annotated[float, Interval(ge=0, le=100)]
"""Exponent of a schedule."""

LearningRate = Annotated[float, Interval(gt=0, le=1000)]

Epsilon = Annotated[float, Interval(ge=1e-12, le=1)]
"""What is added to a denominator."""

GreyLevel = Annotated[float, Interval(ge=0, le=255)]

Seed = Annotated[int, Interval(ge=0, lt=2**32)]
"""Of generators; 0 is a seed."""

NumSteps = Annotated[int, Interval(ge=1, le=10**8), doc("more steps would take years")]

NumStepsOrZero = Annotated[int, Interval(ge=0, le=10**8), doc("more steps would take years")]

BatchSize = Annotated[int, Interval(ge=1, le=4096), doc("images held in memory at once")]

Workers = Annotated[int, Interval(ge=0, le=1024), doc("processes on one machine")]

Threads = Annotated[int, Interval(ge=1, le=1024), doc("threads of one process")]

Pixels = Annotated[int, Interval(ge=1, le=8192), doc("pixels")]
"""Side of an image or of a part of it."""

Lengths = Annotated[tuple[Pixels, ...], Len(1, 1000)]
"""Sides that one is drawn from."""

Size = tuple[Pixels, Pixels]
"""Height and width."""

Channels = Annotated[int, Interval(ge=1, le=8192), doc("channels")]

BaseWidth = Annotated[int, Interval(ge=1, le=1024), doc("channels; deep layers have 32 times more")]

Blocks = Annotated[int, Interval(ge=1, le=1000), doc("layers")]

Widths = tuple[Channels, Channels, Channels, Channels]
"""Channels, or heads, of four stages."""

Depths = tuple[Blocks, Blocks, Blocks, Blocks]
"""Blocks of four stages."""

MlpRatio = Annotated[float, Interval(gt=0, le=64)]
"""Width of a block's feed-forward network over the block's."""

Names = tuple[Text, ...]

Byte = Annotated[int, Interval(ge=0, le=255)]

Colour = tuple[Byte, Byte, Byte]
"""Red, green, blue."""

NumClasses = Annotated[
    int, Interval(ge=1, le=255), doc("labels are bytes, of which 255 is ignored")
]

NumPoints = Annotated[int, Interval(ge=1, le=10**6), doc("points held in memory for every mask")]


def rising(ends: tuple[float, ...]) -> bool:
    """Whether no number is smaller than the one before it."""
    return all(a <= b for a, b in zip(ends, ends[1:], strict=False))


EXTENDING = "docs/extending.md has an example"


class InputError(ValueError):
    """A mistake of the user's: one sentence, shown without a traceback, exit code 2.

    The sentence says what was expected, what came, which file or key, and what to do.
    """


class RunError(RuntimeError):
    """A run that cannot go on (a loss that is no longer finite): one sentence, exit code 1."""


@dataclass(frozen=True)
class Budget:
    """How much of one kind of file is read, so that none fills the memory.

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
                f"{text} million; if it is the file that you mean, set {self.variable}="
                f"{-(-amount // 1_000_000)}."
            )


PIXELS = Budget("RGBT_MAX_MEGAPIXELS", 100, "pixels")
"""Of an image. The largest of the supported data sets has 1.3 million; 100 take 800 MB at most."""

ARRAYS = Budget("RGBT_MAX_ARRAY_MB", 512, "bytes")
"""Of the arrays of a file. Counts of 10,000 images, 9 regions and 26 classes take 487 MB."""

CONTENT = Budget("RGBT_MAX_FILE_MB", 1000, "bytes")
"""Of an image file or a list. 100 million pixels of four 16-bit channels take 800 MB unpacked."""

TEXT = Budget("RGBT_MAX_JSON_MB", 32, "bytes")
"""Of a JSON file. 50,000 lines of metrics take 25 MB; the objects of 32 MB take up to 800 MB."""


def read_bytes(path: Path, budget: Budget) -> bytes:
    """Every byte of a regular file of at most the size that `budget` allows.

    Raises:
        InputError: no regular file, or a larger one.
        OSError: it is missing or cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        what = "a folder" if stat.S_ISDIR(status.st_mode) else "no regular file"
        raise InputError(f"{path} is {what}, expected a file.")
    budget.check(path, status.st_size)
    return path.read_bytes()


def one_line(text: object) -> str:
    """`text` in one line without control characters, at most 200 characters long."""
    words = " ".join(str(text).split())
    plain = "".join(each if each.isprintable() else "?" for each in words).rstrip(".")
    return plain if len(plain) <= 200 else f"{plain[:197]}..."


SEAL = "crc32"
"""Key under which a mapping in a JSON file holds the check sum of all its other entries."""


def sealed(value: Mapping[str, Any]) -> dict[str, Any]:
    """`value` as JSON holds it, with its check sum as the last entry (`SEAL`)."""
    plain = json.loads(json.dumps(value))
    return {**plain, SEAL: _check_sum(plain)}


def read_json(path: Path, form: Any, advice: str) -> Any:
    """What a JSON file holds, of the type `form`, without its seal; see `parse_json`.

    Args:
        path: of the file, which exists.
        form: such as ``list[str]`` or a TypedDict.
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
    """The value that `text` says.

    The seal of a mapping, and of each mapping of a list, is compared and removed. What has none is
    of before there were any, so that it has no other keys than a TypedDict `form` names.

    Raises:
        ValueError: no JSON in UTF-8, another type than `form`, or another check sum.
    """
    import pydantic
    from typing_extensions import is_typeddict

    try:
        found = json.loads(text)
        values = found if isinstance(found, list) else [found]
        are_sealed = all([_unseal(value) for value in values])
        _adapter(form).validate_python(found, strict=True)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error
    except pydantic.ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"]))
        raise ValueError(f"{where}: {first['msg']}".removeprefix(": ")) from error
    strange = set(found) - set(form.__annotations__) if is_typeddict(form) else set()
    if strange and not are_sealed:
        raise ValueError(f"unknown key '{min(strange)}'")
    return found


def _unseal(value: Any) -> bool:
    """Whether a value had a seal, which is removed in place."""
    if not isinstance(value, dict) or SEAL not in value:
        return False
    if value.pop(SEAL) != _check_sum(value):
        raise ValueError("its check sum is another one")
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
        raise ValueError(f"arrays of version {version} are not read")
    try:
        shape, _, dtype = read(file)
    except (SyntaxError, TypeError, tokenize.TokenError, RecursionError) as error:
        raise ValueError("its header is damaged") from error
    if dtype.hasobject:
        raise ValueError("it holds Python objects, which are not read")
    wanted = math.prod(shape) * dtype.itemsize
    if any(length < 0 for length in shape) or wanted != size - file.tell():
        raise ValueError(f"its header announces {wanted} bytes, there are {size - file.tell()}")
    return dtype.kind, tuple(shape)


def nearest(word: str, known: Iterable[str]) -> str:
    """`known`, listed, led by the nearest name: "did you mean 'grbm'? known: crm, grbm"."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}known: {', '.join(names)}"


def split_list(text: str, what: str) -> list[str]:
    """The entries of a list as people type it: "a,b", "[a, b]", also one entry alone.

    Example:
        >>> split_list("[crm, grbm sizes=[240,480]]", "runs")
        ['crm', 'grbm sizes=[240,480]']

    Args:
        text: entries with commas between them, in brackets or not; commas within further brackets
            belong to an entry.
        what: the entries are, for the message.

    Raises:
        InputError: an entry is empty.
    """
    whole = re.fullmatch(r"\s*\[((?:[^\[\]]|\[[^\[\]]*\])*)\]\s*", text)
    inner = whole[1] if whole else text
    words = [word.strip() for word in re.split(r",(?![^\[]*\])", inner)]
    if not all(words):
        raise InputError(f"'{text}': expected {what}, with commas between them.")
    return words


def check_range(name: str, value: float, low: float, high: float) -> None:
    """Raise InputError unless low <= value <= high (NaN never passes)."""
    if not low <= value <= high:
        raise InputError(f"{name} must lie in [{low:g}, {high:g}], got {value:g}.")


def check_choice(name: str, value: str, known: Iterable[str]) -> None:
    """Raise InputError unless `value` is one of `known`; names the nearest one."""
    names = list(known)
    if value not in names:
        raise InputError(f"{name}: '{value}' is not a choice; {nearest(value, names)}.")


def not_finite(tensors: Mapping[str, Tensor]) -> list[str]:
    """Names of the tensors that hold NaN or infinity, in their order."""
    # The sums first, all before any is waited for: a sum is fast, and not finite if a part is not.
    sums = {name: tensor.sum().isfinite() for name, tensor in tensors.items()}
    return [name for name, each in sums.items() if not each and not tensors[name].isfinite().all()]


def check_shape(name: str, tensor: Tensor, letters: str, **sizes: int) -> dict[str, int]:
    """Sizes of `tensor` by letter, raising where rank or a known size differs.

    Example:
        >>> check_shape("label", torch.zeros(2, 4, 6), "B H W", B=2)["W"]
        6

    Args:
        name: what the tensor is called in the message.
        tensor: any tensor.
        letters: space-separated, one per dimension, e.g. "B H W".
        sizes: sizes that are already fixed, by letter.

    Returns:
        letter -> size.

    Raises:
        ValueError: expected and actual shape, when they differ.
    """
    names = letters.split()
    found = dict(zip(names, tensor.shape, strict=False))
    expected = {letter: sizes.get(letter, found.get(letter, -1)) for letter in names}
    if len(names) != tensor.dim() or found != expected:
        wanted = " x ".join(f"{n}={sizes[n]}" if n in sizes else n for n in names)
        raise ValueError(f"{name}: expected shape {wanted}, got {tuple(tensor.shape)}.")
    return found


def check_members(
    key: str, part: object, attributes: Iterable[str], calls: Mapping[str, Sequence[str]]
) -> None:
    """Refuse a part of somebody's own that lacks what the lab uses of it.

    Args:
        key: node of the configuration that names it, for the message.
        part: any object.
        attributes: names that it must have.
        calls: method -> its arguments in order; those that end in "=" are passed by keyword.

    Raises:
        InputError: naming the class, the member and how it is used.
    """
    name = type(part).__name__
    for attribute in attributes:
        if not hasattr(part, attribute):
            raise InputError(f"{key}: {name} has no attribute `{attribute}`; {EXTENDING}.")
    for method, arguments in calls.items():
        function = getattr(part, method, None)
        used = f"{method}({', '.join(arguments).replace('=', '=...')})"
        if not callable(function):
            raise InputError(f"{key}: {name} has no method {used}; {EXTENDING}.")
        by_keyword = {each[:-1]: None for each in arguments if each.endswith("=")}
        try:
            inspect.signature(function).bind(
                *arguments[: len(arguments) - len(by_keyword)], **by_keyword
            )
        except TypeError as error:
            raise InputError(
                f"{key}: {name}.{method} is called as {used}, which it does not accept ({error}); "
                f"{EXTENDING}."
            ) from None


def described(value: object) -> str:
    """What a value is, for a message: "Tensor (2, 9, 4, 6) float32", "dict with loss", "None"."""
    if value is None:
        return "None"
    kind = type(value).__name__
    if hasattr(value, "shape") and hasattr(value, "dtype"):
        return f"{kind} {tuple(value.shape)} {str(value.dtype).removeprefix('torch.')}"
    if isinstance(value, Mapping):
        return f"{kind} with {', '.join(map(str, value)) or 'nothing'}"
    if isinstance(value, str | int | float | bool):
        return f"{kind} {value!r}"
    return kind
