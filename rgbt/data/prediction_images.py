"""Read predicted label images written by any method, without guessing.

Formats: one channel of class indices (`rgbt.predict` and most releases write these), a palette PNG,
or RGB in the colours of a palette. `rgbt.data.prediction_format` recognises the format of all files
of a method together; here one file is read in a known format.
"""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from rgbt.checks import InputError, one_line
from rgbt.data.files import UNREADABLE
from rgbt.data.integrity import PNG, read_image
from rgbt.data.palettes import Palette
from rgbt.types import IGNORE

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


class PredictionReader:
    """Reads predictions of one format in terms of the classes of a data set.

    Args:
        classes: K names.
        palette: whose colours, as a viewer shows them, are read; None: the stored numbers are
            indices, whatever colours go with them (RGB with three equal channels too).

    Raises:
        InputError: two classes of the palette have one colour.
    """

    def __init__(self, classes: tuple[str, ...], palette: Palette | None = None) -> None:
        self.classes = classes
        self.palette = palette
        if palette is not None:
            known = palette.classes(len(classes))
            # A table over all colours makes a file of colours as fast as a file of indices.
            self._class_of_colour = np.full(NUM_COLOURS, UNKNOWN, np.uint8)
            colours = packed(np.array(list(known), np.uint8))
            self._class_of_colour[colours] = list(known.values())

    def read(self, path: Path) -> Array:
        """Class indices (H, W) uint8, all below K.

        Raises:
            InputError: not readable, an unknown index or colour, or two possible readings.
        """
        if self.palette is not None:
            return self._from_colours(decode(path, "RGB"), path, self.palette)
        header = read_header(path)
        if header.kind == "one channel" and header.bits != 8:  # decoders stretch these to 0..255
            raise InputError(
                f"{path}: expected 8 bits per pixel, got {header.bits}; save it as 8 bit, so that "
                "its values are read as they are."
            )
        if header.kind != "colours":
            return self._checked(decode(path), path)
        rgb = decode(path, "RGB")
        if (rgb != rgb[..., :1]).any():
            raise InputError(
                f"{path}: format=index expects one channel of indices or three equal ones, got "
                "three that differ; use format=colour."
            )
        return self._checked(rgb[..., 0].copy(), path)

    def _from_colours(self, rgb: Array, path: Path, palette: Palette) -> Array:
        found = self._class_of_colour[packed(rgb)]
        unknown = found == UNKNOWN
        if unknown.any():
            row, column = (int(place[0]) for place in np.nonzero(unknown))
            colour = rgb[row, column].astype(int)
            known = list(palette.classes(len(self.classes)))
            near = int(((np.array(known) - colour) ** 2).sum(1).argmin())
            raise InputError(
                f"{path}: colour {tuple(colour.tolist())} at row {row}, column {column} is the "
                f"colour of no class ({int(unknown.sum())} such pixels); the nearest in "
                f"{palette.description} is {self.classes[near]} {known[near]}: write its colours "
                "without smoothing, name the palette with palette=..., or save indices."
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


def packed(rgb: Array) -> NDArray[np.int32]:
    """(..., 3) colours as one number each, 0 .. 2^24 - 1."""
    wide = rgb.astype(np.int32)
    number: NDArray[np.int32] = (wide[..., 0] << 16) | (wide[..., 1] << 8) | wide[..., 2]
    return number


def decode(path: Path, mode: Literal["stored", "RGB"] = "stored") -> Array:
    """Pixels as stored, palettes as indices; or as the colours that are shown.

    Pillow, because OpenCV shows palettes as colours and cannot give their indices.
    """
    data = read_image(path, "write the prediction again")
    try:
        with Image.open(io.BytesIO(data)) as image:
            if mode == "stored":
                return np.array(image, np.uint8)
            shown = image.convert("RGBA")
    except UNREADABLE as error:
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
