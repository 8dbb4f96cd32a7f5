"""One predicted label image, read without guessing: indices, a palette with indices, or colours.

A palette PNG states the class of a pixel twice: by its index and by the colour of that index. The
file is read where both agree with the data set. Where they do not, the user has to choose, because
only the user knows what the method wrote (PASCAL VOC's palette has colours of MFNet at other
indices).
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rgbt.checks import InputError, one_line
from rgbt.data.integrity import PNG, UNREADABLE, read_image
from rgbt.types import IGNORE

Format = Literal["auto", "index", "colour"]
Kind = Literal["one channel", "a palette", "colours"]
Array = NDArray[np.uint8]

KINDS: dict[int, Kind] = {0: "one channel", 2: "colours", 3: "a palette", 6: "colours"}
"""PNG's colour types (PNG specification, 11.2.2) as far as a label image can have them."""

UNKNOWN = 255
"""In the table of colours: no class has this one. Classes end at 254, because 255 is ignore."""

NUM_COLOURS = 2**24


class Header(NamedTuple):
    """Content of the first bytes of a PNG: kind of its pixels, and bits per channel."""

    kind: Kind
    bits: int


def read_header(path: Path) -> Header:
    """Header of a PNG; nothing is decoded.

    Raises:
        InputError: no PNG, more than 8 bits, or grey with transparency.
    """
    with path.open("rb") as file:
        start = file.read(26)
    if len(start) < 26 or not start.startswith(PNG):
        raise InputError(f"{path} is not a PNG file or is damaged; write the prediction again.")
    bits, colour_type = struct.unpack("BB", start[24:26])
    if bits > 8:
        raise InputError(f"{path}: expected 8 bits per channel, got {bits}; save it as 8 bit.")
    if colour_type not in KINDS:
        raise InputError(
            f"{path}: expected one channel of indices, a palette or RGB colours, got grey with "
            "transparency; save it without."
        )
    return Header(KINDS[colour_type], bits)


def check_one_kind(paths: Iterable[Path]) -> None:
    """Refuse files that "auto" would read in different ways, before any of them is decoded.

    Otherwise, an image optimiser that stores a black colour image as one channel would turn the
    colours of some images into indices.

    Raises:
        InputError: not all files are of one kind, or one is no 8 bit PNG.
    """
    seen: dict[Kind, Path] = {}
    for path in paths:
        seen.setdefault(read_header(path).kind, path)
    if len(seen) > 1:
        (kind, path), (other, other_path) = list(seen.items())[:2]
        raise InputError(
            f"some predictions are PNGs with {kind} ({path}), others with {other} ({other_path}); "
            "choose one reading: format=index (the stored numbers) or format=colour (the colours "
            "shown)."
        )


class PredictionReader:
    """Reads predictions in terms of the classes of a data set.

    Args:
        classes: K names.
        palette: K (red, green, blue) colours.
        form: how files are read. "auto": one channel holds indices, RGB holds colours, and a
            palette counts where its indices and its colours say the same; "index": the stored
            numbers, whatever colours go with them (RGB with three equal channels too); "colour":
            the colours that a viewer shows.
    """

    def __init__(
        self,
        classes: tuple[str, ...],
        palette: tuple[tuple[int, int, int], ...],
        form: Format = "auto",
    ) -> None:
        self.classes = classes
        self.palette = palette
        self.form = form
        # A table over all colours makes a file of colours as fast as a file of indices.
        self._class_of_colour = np.full(0 if form == "index" else NUM_COLOURS, UNKNOWN, np.uint8)
        if form != "index":
            self._class_of_colour[_packed(np.array(palette, np.uint8))] = np.arange(len(classes))

    def read(self, path: Path) -> Array:
        """Class indices (H, W) uint8, all below K.

        Raises:
            InputError: not readable, an unknown index or colour, or two possible readings.
        """
        header = read_header(path)
        if self.form == "colour" or (self.form == "auto" and header.kind == "colours"):
            self._check_colours_differ()
            return self._from_colours(_decode(path, "RGB"), path)
        if header.kind == "one channel" and header.bits != 8:  # decoders stretch these to 0..255
            raise InputError(
                f"{path}: expected 8 bits per pixel, got {header.bits}; save it as 8 bit, so that "
                "its values are read as they are."
            )
        if header.kind == "colours":
            rgb = _decode(path, "RGB")
            if (rgb != rgb[..., :1]).any():
                raise InputError(
                    f"{path}: format=index expects one channel of indices or three equal ones, got "
                    "three that differ; use format=colour."
                )
            return self._checked(rgb[..., 0].copy(), path)
        indices = _decode(path)
        if header.kind == "a palette" and self.form == "auto":
            self._check_palette(indices, path)
        return self._checked(indices, path)

    def _from_colours(self, rgb: Array, path: Path) -> Array:
        found = self._class_of_colour[_packed(rgb)]
        unknown = found == UNKNOWN
        if unknown.any():
            row, column = (int(place[0]) for place in np.nonzero(unknown))
            colour = rgb[row, column].astype(int)
            away = ((np.array(self.palette, int) - colour) ** 2).sum(1)
            near = int(away.argmin())
            raise InputError(
                f"{path}: colour {tuple(colour.tolist())} at row {row}, column {column} is the "
                f"colour of no class ({int(unknown.sum())} such pixels); the nearest is "
                f"{self.classes[near]} {tuple(self.palette[near])}: write colours of "
                "dataset.palette without smoothing, or save indices (format=index where equal "
                "channels hold them)."
            )
        return found

    def _checked(self, indices: Array, path: Path) -> Array:
        last = len(self.classes) - 1
        wrong = indices > last
        if not wrong.any():
            return indices
        value = int(indices[wrong][0])
        if value == IGNORE:
            raise InputError(
                f"{path}: {int((indices == IGNORE).sum())} pixels are {IGNORE}; a prediction "
                f"cannot ignore pixels; it needs a class 0 to {last} at every pixel."
            )
        raise InputError(
            f"{path}: value {value} is not a class; expected 0 to {last} (the last one, "
            f"{self.classes[last]}), so map the method's indices to those of the data set first."
        )

    def _check_palette(self, indices: Array, path: Path) -> None:
        """InputError unless the indices in use have the data set's colours."""
        with Image.open(path) as image:
            flat = image.getpalette("RGB") or []
        for index in np.unique(indices).tolist():
            shown = tuple(flat[3 * index : 3 * index + 3])
            known = tuple(self.palette[index]) if index < len(self.palette) else ()
            if len(shown) < 3 or shown != known:
                there = f"only the classes 0 to {len(self.classes) - 1}"
                if known:
                    there = f"{self.classes[index]} {known} there"
                raise InputError(
                    f"{path}: palette index {index} is shown as "
                    f"{shown if len(shown) == 3 else 'no colour'} but the "
                    f"data set has {there}; choose one reading: "
                    "format=index (the stored numbers) or format=colour (the colours shown)."
                )

    def _check_colours_differ(self) -> None:
        first: dict[tuple[int, ...], str] = {}
        for name, colour in zip(self.classes, map(tuple, self.palette), strict=True):
            if colour in first:
                raise InputError(
                    f"dataset.palette gives {first[colour]} and {name} the same colour {colour}, "
                    "so a colour does not identify a class; save predictions as indices."
                )
            first[colour] = name


def _packed(rgb: Array) -> NDArray[np.int32]:
    """(..., 3) colours as one number each, 0 .. 2^24 - 1."""
    wide = rgb.astype(np.int32)
    number: NDArray[np.int32] = (wide[..., 0] << 16) | (wide[..., 1] << 8) | wide[..., 2]
    return number


def _decode(path: Path, mode: Literal["stored", "RGB"] = "stored") -> Array:
    """Pixels as stored, palettes as indices; or as the colours that are shown.

    Pillow, because OpenCV shows palettes as colours and cannot give their indices.
    """
    data = read_image(path, "write the prediction again")
    try:
        with Image.open(io.BytesIO(data)) as image:
            if mode == "stored":
                return np.array(image, np.uint8)
            shown = image.convert("RGBA")
    except (*UNREADABLE, zlib.error) as error:
        raise InputError(
            f"{path} cannot be decoded ({one_line(error)}); write the prediction again."
        ) from error
    rgba: Array = np.array(shown, np.uint8)
    if (rgba[..., 3] < 255).any():
        raise InputError(
            f"{path}: {int((rgba[..., 3] < 255).sum())} pixels are transparent, so their colour is "
            "no prediction; save it without transparency."
        )
    return rgba[..., :3]
