"""The meaning of values in a user's files: labels become classes, thermal values grey levels.

Part of `rgbt.data.folder`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.data.files import decode, one_channel, read_array, read_colours, read_indices
from rgbt.ranges import Colour
from rgbt.types import IGNORE

Array = NDArray[np.uint8]
LabelValue = Annotated[int, Interval(ge=-(2**31), lt=2**31)]
Colours = Mapping[str, Colour | tuple[Colour, ...]]
Level = Annotated[float, Interval(ge=-1e6, le=1e6)]
Range = tuple[Level, Level]


@dataclass(frozen=True)
class LabelCodes:
    """Values of label files and the class of each.

    Attributes:
        codes: whole number -> class index, or 255; a colour is 65536 red + 256 green + blue.
        of_colours: whether the files hold colours.
    """

    codes: dict[int, int]
    of_colours: bool

    def read(self, path: Path) -> Array:
        """Class indices (H, W) uint8, 255 = ignored, of an image or a `.npy` file.

        Raises:
            InputError: it cannot be read, or holds a value that no key names: which, and how often.
        """
        raw = self._raw(path)
        known = np.array(sorted(self.codes), np.int64)
        indices = np.minimum(np.searchsorted(known, raw), len(known) - 1)
        unknown = known[indices] != raw
        if unknown.any():
            raise InputError(f"{path}: {self._unknown(raw[unknown])}")
        return np.array([self.codes[code] for code in known.tolist()], np.uint8)[indices]

    def _raw(self, path: Path) -> NDArray[Any]:
        if self.of_colours:
            red, green, blue = np.moveaxis(read_colours(path).astype(np.int64), -1, 0)
            return np.asarray(65536 * red + 256 * green + blue)
        if path.suffix.lower() != ".npy":
            return read_indices(path)
        raw = read_array(path, "whole numbers of shape (rows, columns)")
        if raw.dtype.kind not in "iu" or raw.ndim != 2:
            raise InputError(
                f"{path}: expected whole numbers of shape (rows, columns), got {raw.shape} "
                f"{raw.dtype}; save the values of dataset.ids."
            )
        return raw

    def _unknown(self, unknown: NDArray[Any]) -> str:
        codes, counts = np.unique(unknown, return_counts=True)
        code, count = int(codes[counts.argmax()]), counts.max()
        more = f", most frequent of {len(codes)} unknown ones" if len(codes) > 1 else ""
        if self.of_colours:
            colour = [code // 65536, code // 256 % 256, code % 256]
            return (
                f"colour {colour} ({count} pixels{more}) is neither in dataset.colours nor in "
                "dataset.ignored; add it there, or save labels that were never resized."
            )
        return (
            f"label value {code} ({count} pixels{more}) is neither in dataset.ids nor in "
            f"dataset.ignored (known: {', '.join(map(str, sorted(self.codes)))}); add it there."
        )


def label_codes(
    classes: tuple[str, ...],
    ids: dict[int, str] | None,
    colours: Colours | None,
    ignored: tuple[int | Colour, ...],
) -> LabelCodes:
    """What the configuration says of label values, see `rgbt.data.folder.dataset.Folder`.

    Without `ids` and `colours` a value is the index of its class; 255 is ignored unless `ids` gives
    it a class.

    Raises:
        InputError: both ids and colours, an unknown class, an invalid value or colour, or one
            that occurs twice.
    """
    if ids is not None and colours is not None:
        raise InputError(
            "dataset.ids and dataset.colours: labels hold either numbers or colours; set one of "
            "them to null."
        )
    key = "dataset.ids" if colours is None else "dataset.colours"
    pairs = list(_pairs(classes, ids, colours))
    for word, _ in pairs:
        if word not in classes:
            raise InputError(f"{key}: '{word}' is no class; {nearest(word, classes)}.")
    codes: dict[int, int] = {}
    named = [(classes.index(word), value) for word, value in pairs]
    for index, value in [*named, *((IGNORE, value) for value in ignored)]:
        code = _code(value, of_colours=colours is not None)
        if code in codes:
            raise InputError(
                f"{key}: {_plain(value)} occurs twice in the classes and dataset.ignored; every "
                "value must have one meaning."
            )
        codes[code] = index
    if colours is None:
        codes.setdefault(IGNORE, IGNORE)
    if not codes:
        raise InputError("dataset.colours: expected the colour of every class, got none.")
    return LabelCodes(codes, of_colours=colours is not None)


def _pairs(
    classes: tuple[str, ...], ids: dict[int, str] | None, colours: Colours | None
) -> Iterable[tuple[str, int | Colour]]:
    if colours is None:
        words = dict(enumerate(classes)) if ids is None else ids
        return ((word, value) for value, word in words.items())
    return ((word, colour) for word, given in colours.items() for colour in each_colour(given))


def each_colour(given: Colour | tuple[Colour, ...]) -> tuple[Colour, ...]:
    """The colours of a class, which may be one or several."""
    is_one = all(isinstance(each, int) for each in given)
    return (cast(Colour, given),) if is_one else cast(tuple[Colour, ...], given)


def _code(value: int | Colour, *, of_colours: bool) -> int:
    if isinstance(value, int) == of_colours:
        wanted = "a colour [red, green, blue]" if of_colours else "a whole number"
        raise InputError(
            f"dataset.ignored: expected {wanted}, as labels hold such, got {_plain(value)}."
        )
    if isinstance(value, int):
        return value
    red, green, blue = value
    return 65536 * red + 256 * green + blue


def _plain(value: int | Colour) -> str:
    return str(value if isinstance(value, int) else list(value))


def painted(num_classes: int) -> tuple[Colour, ...]:
    """Colours that differ for up to 256 classes, the first of them black.

    The bits of the index are dealt out to red, green and blue in turn, each from its highest bit
    downwards: 0 black, 1 dark red, 2 dark green, 3 dark yellow, as in the masks of PASCAL VOC.
    """
    return tuple(
        (_level(index), _level(index >> 1), _level(index >> 2)) for index in range(num_classes)
    )


def _level(number: int) -> int:
    """Every third bit of `number`, the lowest as 128, the next as 64, the next as 32."""
    return sum((number >> 3 * place & 1) << 7 - place for place in range(3))


def read_values(path: Path) -> NDArray[Any]:
    """Values of a thermal camera, (H, W) at their own depth, of an image or a `.npy` file.

    Raises:
        InputError: it cannot be read, has channels that differ, other than real numbers, or NaN.
    """
    if path.suffix.lower() == ".npy":
        values = read_array(path, "thermal values of shape (rows, columns)")
    else:
        values = decode(path)
    if values.dtype.kind not in "iuf" or values.ndim not in (2, 3):
        raise InputError(
            f"{path}: expected thermal values of shape (rows, columns), got {values.shape} "
            f"{values.dtype}; save whole or real numbers."
        )
    if values.dtype.kind == "f" and not np.isfinite(values).all():
        wrong = np.count_nonzero(~np.isfinite(values))
        raise InputError(
            f"{path}: {wrong} thermal values are NaN or infinite; write a temperature there (that "
            "of a neighbour, or one outside dataset.thermal_range)."
        )
    return one_channel(values, path)


def grey(values: NDArray[Any], limits: Range | None, path: Path) -> Array:
    """Grey levels of thermal values: round(255 (min(max(v, low), high) - low) / (high - low)).

    Halves go upwards. Without `limits`, (low, high), the values are grey levels.

    Raises:
        InputError: values of another depth than 8 bits without limits, or of 8 bits with limits
            that these cannot reach; the message names `path`.
    """
    if limits is None:
        if values.dtype != np.uint8:
            raise InputError(
                f"{path}: expected 8 bits per pixel, got {values.dtype}; give "
                "dataset.thermal_range=[low, high], the values that become black and white."
            )
        return np.asarray(values, np.uint8)
    if values.dtype == np.uint8 and limits[0] >= 255:
        raise InputError(
            f"{path}: expected values of the camera in dataset.thermal_range={plain(limits)}, got "
            "8 bits; use the original file, or set dataset.thermal_range=null for grey levels."
        )
    if values.dtype == np.uint16:
        return np.take(levels_of_16_bits(*limits), values)
    return _stretched(values, *limits)


def check_limits(limits: Range | None) -> None:
    """Refuse a range that is no range."""
    if limits is not None and not -math.inf < limits[0] < limits[1] < math.inf:
        raise InputError(
            "dataset.thermal_range: expected [low, high] with low < high, the thermal values that "
            f"become black and white, got {plain(limits)}."
        )


def plain(limits: Range) -> str:
    """The two numbers as they are typed: 21800 and not 21800.0."""
    return f"[{limits[0]:g}, {limits[1]:g}]" if max(map(abs, limits)) < 1e5 else str(list(limits))


@lru_cache(maxsize=4)
def levels_of_16_bits(low: float, high: float) -> Array:
    """(65536,) uint8, the grey level of every value of 16 bits."""
    return _stretched(np.arange(np.iinfo(np.uint16).max + 1), low, high)


def _stretched(values: NDArray[Any], low: float, high: float) -> Array:
    above = np.clip(values.astype(np.float64), low, high) - low
    span = high - low
    return np.floor_divide(2 * 255 * above + span, 2 * span).astype(np.uint8)
