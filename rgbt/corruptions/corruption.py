"""The interface of corruptions, which change the pixels of a pair or show another frame.

Severity 0 is the clean image and never reaches a corruption: `rgbt.evaluation.request`
returns such samples as they are. Lengths are given in pixels of an image of `REFERENCE_HEIGHT` rows
and scaled to the height of the file, so that one ladder serves MFNet (480), PST900 (720) and the
embedded data (120).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, Protocol, runtime_checkable

import numpy as np
from annotated_types import Interval, Len

from rgbt.checks import InputError
from rgbt.types import Sample

REFERENCE_HEIGHT = 480
"""Rows of the images that lengths in pixels are given for: MFNet's."""

Image = Literal["rgb", "thermal"]
Images = Literal["rgb", "thermal", "both"]
"""Which image of a pair is corrupted."""

IMAGES: dict[Images, tuple[Image, ...]] = {
    "rgb": ("rgb",),
    "thermal": ("thermal",),
    "both": ("rgb", "thermal"),
}
NAMES: dict[Images, str] = {"rgb": "RGB", "thermal": "thermal", "both": "RGB and thermal"}
"""Names in tables and figures."""

RngOf = Callable[[str], np.random.Generator]
"""Purpose -> generator of a sample. It does not depend on the severity: a higher one hides the
same blocks and more, so that the severities of a ladder differ in nothing else."""


Severities = Annotated[tuple[Annotated[float, Interval(gt=0, le=1000)], ...], Len(1, 100)]
"""A ladder; the range of each kind is in its `check`."""


class Kind(Protocol):
    """Members that every corruption declares.

    Attributes:
        title: name in tables and figures, e.g. "noise, RGB".
        unit: of the severity, e.g. "grey levels (std)"; "" where there is one severity alone.
        severities: its severities, rising; `rgbt robustness` measures all of them.
    """

    title: str
    unit: str
    severities: tuple[float, ...]

    def check(self, severity: float) -> None:
        """InputError where `severity` (> 0) is out of range."""
        ...


@runtime_checkable
class OfPixels(Kind, Protocol):
    """A corruption that changes the pixels of one pair."""

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """The corrupted `sample`, uint8 as before; the label and the name stay.

        Raises:
            InputError: the severity changes nothing of an image of this size.
        """
        ...


@runtime_checkable
class OfTime(Kind, Protocol):
    """A corruption that shows the thermal image of another frame."""

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`; 0 is the first frame."""
        ...


Corruption = OfPixels | OfTime


def check_ladder(kind: Kind) -> None:
    """InputError for an empty ladder, one that does not rise, and severities out of range."""
    ladder = kind.severities
    if not ladder or any(low >= high for low, high in zip((0.0, *ladder), ladder, strict=False)):
        raise InputError(
            "corruption.severities must be rising numbers above 0 (0 is the clean image, which is "
            f"always measured), got {list(ladder)}."
        )
    for severity in ladder:
        kind.check(severity)


def at_height(pixels: float, height: int) -> float:
    """A length of the reference height as a length of an image of `height` rows."""
    return pixels * height / REFERENCE_HEIGHT


def nearest_whole(value: float) -> int:
    """The nearest whole number; halves go up."""
    return math.floor(value + 0.5)
