"""Type aliases that declare the ranges of settings.

A constructor that a configuration names declares the range of each setting in its annotations:
``ratio: Share``, or ``block: Annotated[int, Interval(ge=1, le=480)]``. `rgbt.config` checks them.
"""

from __future__ import annotations

from typing import Annotated, TypeVar

from annotated_types import Interval, Len, Predicate, doc

# A name, a path or a pattern that is not empty: "" would mean the current folder.
Text = Annotated[str, Len(1, 4096), Predicate(str.isprintable), doc("printable characters")]

# A share of something, or a probability.
Share = Annotated[float, Interval(ge=0, le=1)]

# A share below 1: a dropout rate, a momentum.
ShareBelowOne = Annotated[float, Interval(ge=0, lt=1)]

# A weight or a factor; 0 disables the term.
NonNegative = Annotated[float, Interval(ge=0, le=1e6)]

# A factor, a norm or a length that cannot be 0.
Positive = Annotated[float, Interval(gt=0, le=1e6)]

# Exponent of a schedule.
Power = Annotated[float, Interval(ge=0, le=100)]

LearningRate = Annotated[float, Interval(gt=0, le=1000)]

# A constant added to a denominator.
Epsilon = Annotated[float, Interval(ge=1e-12, le=1)]

GreyLevel = Annotated[float, Interval(ge=0, le=255)]

# A seed of generators; 0 is valid.
Seed = Annotated[int, Interval(ge=0, lt=2**32)]

NumSteps = Annotated[int, Interval(ge=1, le=10**8), doc("more steps would take years")]
NumStepsOrZero = Annotated[int, Interval(ge=0, le=10**8), doc("more steps would take years")]
BatchSize = Annotated[int, Interval(ge=1, le=4096), doc("images held in memory at once")]
Workers = Annotated[int, Interval(ge=0, le=1024), doc("processes on one machine")]
Threads = Annotated[int, Interval(ge=1, le=1024), doc("threads of one process")]
NumDevices = Annotated[int, Interval(ge=1, le=1024), doc("devices of one machine")]

# Side of an image or of a part of it.
Pixels = Annotated[int, Interval(ge=1, le=8192), doc("pixels")]

# Side lengths from which one is drawn.
Lengths = Annotated[tuple[Pixels, ...], Len(1, 1000)]

# Height and width.
Size = tuple[Pixels, Pixels]

Channels = Annotated[int, Interval(ge=1, le=8192), doc("channels")]

BaseWidth = Annotated[int, Interval(ge=1, le=1024), doc("channels; deep layers have 32 times more")]

Blocks = Annotated[int, Interval(ge=1, le=1000), doc("layers")]

# Channels, or heads, of four stages.
Widths = tuple[Channels, Channels, Channels, Channels]

# Blocks of four stages.
Depths = tuple[Blocks, Blocks, Blocks, Blocks]

# Width of a block's feed-forward network divided by the width of the block.
MlpRatio = Annotated[float, Interval(ge=1, le=64)]

Names = tuple[Text, ...]

Byte = Annotated[int, Interval(ge=0, le=255)]

# Red, green, blue.
Colour = tuple[Byte, Byte, Byte]

NumClasses = Annotated[
    int, Interval(ge=1, le=255), doc("labels are bytes, of which 255 is ignored")
]

NumPoints = Annotated[int, Interval(ge=1, le=10**6), doc("points held in memory for every mask")]


Number = TypeVar("Number", int, float)


def rising(ends: tuple[float, ...]) -> bool:
    """Say whether no number is smaller than the one before it."""
    return all(a <= b for a, b in zip(ends, ends[1:], strict=False))


# Two ends of a range.
Rising = Annotated[tuple[Number, Number], Predicate(rising), doc("the smaller one first")]
