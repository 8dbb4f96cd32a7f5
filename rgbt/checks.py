"""One wording for bad input, ranges of settings as types, the shape check of public borders.

A constructor that a configuration names declares the range of each setting in its annotations:
``ratio: Share``, or ``block: Annotated[int, Interval(ge=1, le=480)]``. `rgbt.config` checks them.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Annotated

from annotated_types import Interval, Len, Predicate, doc

if TYPE_CHECKING:  # the command line answers --help without waiting for torch
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


class InputError(ValueError):
    """A mistake of the user's: one sentence, shown without a traceback, exit code 2.

    The sentence says what was expected, what came, which file or key, and what to do.
    """


class RunError(RuntimeError):
    """A run that cannot go on (a loss that is no longer finite): one sentence, exit code 1."""


def nearest(word: str, known: Iterable[str]) -> str:
    """`known`, listed, led by the nearest name: "did you mean 'grbm'? known: crm, grbm"."""
    names = sorted(known)
    close = difflib.get_close_matches(word, names, n=1, cutoff=0.5)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"{hint}known: {', '.join(names)}"


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
