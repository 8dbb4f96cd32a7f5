"""Map the values of label files to classes or to "ignored"."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.files import open_indices, read_array, read_colours, values_of
from rgbt.dataset import LabelledDataset
from rgbt.ranges import Colour
from rgbt.types import IGNORE

# Labels of a split that are read to see which classes they show.
MOST_LABELS = 100

Array = NDArray[np.uint8]
PixelCounts = NDArray[np.int64]
LabelValue = Annotated[int, Interval(ge=-(2**31), lt=2**31)]
Colours = Mapping[str, Colour | tuple[Colour, ...]]


@dataclass(frozen=True)
class LabelCodes:
    """Holds values of label files and the class of each.

    Attributes:
        codes: whole number -> class index, or 255; a colour is 65536 red + 256 green + blue.
        key: of the configuration that names the values; "" where they are fixed, and of 8 bits.
        of_colours: whether the files hold colours.
        assumed: whether 255 is ignored by default, not by a setting.
    """

    codes: dict[int, int]
    key: str = ""
    of_colours: bool = False
    assumed: bool = False

    def read(self, path: Path) -> Array:
        """Read class indices (H, W) uint8, 255 = ignored, of an image or a `.npy` file.

        Raises:
            InputError: it cannot be read, or holds a value without a class: which, and how often.
        """
        if self.of_colours:
            return self.classes(code_of(read_colours(path)), path)
        if path.suffix.lower() != ".npy":
            raw = values_of(open_indices(path))
            if not self.key and raw.dtype != np.uint8:
                raise InputError(f"{path}: expected 8 bits per channel, got {raw.dtype}.")
            return self.classes(raw, path)
        raw = read_array(path, "whole numbers of shape (rows, columns)")
        if raw.dtype.kind not in "iu" or raw.ndim != 2 or not raw.size:
            raise InputError(
                f"{path}: expected whole numbers of shape (rows, columns), got {raw.shape} "
                f"{raw.dtype}; save class indices, or the values of dataset.ids."
            )
        return self.classes(raw, path)

    def classes(self, raw: NDArray[Any], path: Path) -> Array:
        """Map the values (H, W) of `path`, whole numbers of any type, as `read` does."""
        if raw.dtype == np.uint8:
            classes = np.asarray(cv2.LUT(raw, self._of_bytes))
        else:
            known = np.array(sorted(self.codes), np.int64)
            at = np.minimum(np.searchsorted(known, raw), len(known) - 1)
            of_known = np.array([self.codes[code] for code in known.tolist()], np.int16)
            classes = np.where(known[at] == raw, of_known[at], -1)
        if classes.min() < 0:
            values, counts = np.unique(raw[classes < 0], return_counts=True)
            code, count = int(values[counts.argmax()]), counts.max()
            shown = [code // 65536, code // 256 % 256, code % 256] if self.of_colours else code
            pair = f"CLASS: {shown}" if self.of_colours else f"{shown}: CLASS"
            where, _, setting = self.key.partition(".")
            is_own = where == "dataset"
            advice = f"; in its YAML write {setting}: {{..., {pair}}}, or ignored: [{shown}]"
            raise InputError(
                f"{path}: {'colour' if self.of_colours else 'label value'} {shown} ({count} pixels;"
                f" one of {len(values)} unknown values) has no class in "
                f"{self.key or 'this data set'} and is not ignored{advice if is_own else ''}."
            )
        return np.asarray(classes, np.uint8)

    @cached_property
    def _of_bytes(self) -> NDArray[np.int16]:
        return np.array([self.codes.get(value, -1) for value in range(256)], np.int16)


def code_of(colours: NDArray[Any]) -> NDArray[np.int64]:
    """Join red, green and blue (..., 3) to one number: 65536 red + 256 green + blue."""
    red, green, blue = np.moveaxis(colours.astype(np.int64), -1, 0)
    return np.asarray(65536 * red + 256 * green + blue)


def indices(num_classes: int, *ignored: int) -> LabelCodes:
    """Take values for class indices; 255 and `ignored` do not count."""
    codes = {value: value for value in range(num_classes)}
    return LabelCodes({**codes, **dict.fromkeys((*ignored, IGNORE), IGNORE)}, assumed=True)


def label_codes(
    classes: tuple[str, ...],
    ids: dict[int, str] | None,
    colours: Colours | None,
    ignored: tuple[int | Colour, ...],
) -> LabelCodes:
    """Return the map of label values of a configuration, see `rgbt.data.folder.Folder`.

    Without `ids` and `colours` a value is the index of its class; 255 is ignored unless `ids` gives
    it a class. InputError: both ids and colours, an unknown class, or a value that occurs twice.
    """
    if ids is not None and colours is not None:
        raise InputError("dataset.ids and dataset.colours: set one of them to null.")
    key = "dataset.ids" if colours is None else "dataset.colours"
    pairs: list[tuple[str, int | Colour]]
    if colours is None:
        words = dict(enumerate(classes)) if ids is None else ids
        pairs = [(word, value) for value, word in words.items()]
    else:
        pairs = []
        for word, given in colours.items():
            pairs += [(word, colour) for colour in each_colour(given)]
    for word, _ in pairs:
        check_choice(key, word, classes)
    codes: dict[int, int] = {}
    named = [(classes.index(word), value) for word, value in pairs]
    for index, value in [*named, *((IGNORE, value) for value in ignored)]:
        if isinstance(value, int) != (colours is None):
            raise InputError(f"dataset.ignored: {value} is no value of labels as {key} has them.")
        code = value if isinstance(value, int) else int(code_of(np.array(value)))
        if code in codes:
            raise InputError(f"{key}: {value} occurs twice in the classes and dataset.ignored.")
        codes[code] = index
    is_assumed = colours is None and IGNORE not in codes
    if is_assumed:
        codes[IGNORE] = IGNORE
    if not codes:
        raise InputError("dataset.colours: expected the colour of every class, got none.")
    return LabelCodes(codes, key, of_colours=colours is not None, assumed=is_assumed)


def each_colour(given: Colour | tuple[Colour, ...]) -> tuple[Colour, ...]:
    """Return the colours of a class, which may be one or several."""
    is_one = all(isinstance(level, int) for level in given)
    return (cast(Colour, given),) if is_one else cast(tuple[Colour, ...], given)


def painted(num_classes: int) -> tuple[Colour, ...]:
    """Return colours that differ for up to 256 classes, as in the masks of PASCAL VOC.

    The bits of the index are dealt out to red, green and blue in turn, each from its highest bit
    downwards: 0 black, 1 dark red, 2 dark green, 3 dark yellow.
    """

    def level(number: int) -> int:
        return sum((number >> 3 * place & 1) << 7 - place for place in range(3))

    return tuple((level(i), level(i >> 1), level(i >> 2)) for i in range(num_classes))


def label_pixels(label: Array, num_classes: int) -> PixelCounts:
    """Count the pixels of each class in a label (H, W): (K + 1,), the last are ignored."""
    counts = np.bincount(label.ravel(), minlength=IGNORE + 1)
    return np.append(counts[:num_classes], counts[IGNORE])


def pixels_of(
    dataset: LabelledDataset, name: str, on_error: Literal["raise", "skip"]
) -> PixelCounts:
    """Count `label_pixels` of an image of a data set; 0 without a label.

    A label that cannot be read is an InputError, or counts as none with on_error="skip".
    """
    try:
        label = dataset.label(name)
    except InputError:
        if on_error == "raise":
            raise
        label = None
    return label_pixels(np.empty(0, np.uint8) if label is None else label, dataset.num_classes)


def classes_in(
    dataset: LabelledDataset, names: Sequence[str], on_error: Literal["raise", "skip"]
) -> tuple[PixelCounts, bool]:
    """Count `label_pixels` of the labels that were read, and say whether these are all.

    Reading stops when every scored class has a pixel, and after `MOST_LABELS` labels, evenly
    spread, when two classes have. An unlabelled image has no pixel. InputError: an unreadable one.
    """
    scored = [name not in dataset.unscored for name in dataset.classes]
    pixels = np.zeros(dataset.num_classes + 1, np.int64)
    spread = names[:: -(-len(names) // MOST_LABELS)]
    for number, name in enumerate((*spread, *sorted(set(names) - set(spread)))):
        shown = pixels[:-1] > 0
        is_several = shown.sum() > min(1, dataset.num_classes - 1)
        if is_several and (shown[scored].all() or number >= len(spread)):
            return pixels, False
        pixels += pixels_of(dataset, name, on_error)
    return pixels, True


def of_one_class(pixels: PixelCounts, classes: Sequence[str], codes: LabelCodes | None) -> str:
    """Return a sentence where pixels (K + 1,) are of one class of several, or none; else "".

    With `codes`, it asks whether a value 255 that no setting ignores is another class.
    """
    shown = np.flatnonzero(pixels[:-1]).tolist()
    if len(shown) > 1 or len(classes) < 2 or not pixels.any():
        return ""
    only = f"'{classes[shown[0]]}' alone" if shown else "no class"
    if codes is None or not codes.assumed or not pixels[-1]:
        return f"the labels show {only}; a score over one class is no score"
    index = shown[0] if shown else 0
    other = 1 if index == 0 else 0
    values = [value for value, of_class in codes.codes.items() if of_class == index]
    value = values[0] if values else index
    ids = f"{{{value}: {classes[index]}, {IGNORE}: {classes[other]}}}"
    advice = f"in its YAML write ids: {ids} if it is a class, ignored: [{IGNORE}] if it is none"
    if not codes.key:
        advice = "write the index of the class into the files if it is one"
    share = f"{pixels[-1] / pixels.sum():.1%}"
    return f"the labels show {only} and {IGNORE} ({share} of the pixels, ignored); {advice}"
