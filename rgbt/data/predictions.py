"""Read predicted label images written by any method, in the format that the user states.

A PNG holds class indices in one channel (`rgbt predict` and most releases write these), or shows
the colours of a palette, with or without indices of its own.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.files import opened, read_colours
from rgbt.files.yaml_files import read_yaml

Array = NDArray[np.uint8]
Colour = tuple[int, int, int]
Format = Literal["index", "colour"]

OVERLAY = "_overlay"
"""Ending of the pictures that `rgbt predict` writes beside its predictions."""

UNKNOWN = 255
"""In the table of colours: no class has this one. Classes end at 254, because 255 is ignore."""


class Affixes(NamedTuple):
    """What is before and after the name of an image in the name of its prediction."""

    prefix: str = ""
    suffix: str = ""

    def file_stem(self, name: str) -> str:
        """Name of the prediction without ".png"."""
        return f"{self.prefix}{name}{self.suffix}"


@dataclass(frozen=True, kw_only=True)
class FormatOptions:
    """What the user states about the files of predictions.

    Attributes:
        form: "index": the stored numbers are classes; "colour": the colours shown are.
        palette: of the colours: "dataset", those of the data set; or a YAML file with the key
            `palette`, such as a file of conf/dataset.
        affixes: of the names of the files.
    """

    form: Format = "index"
    palette: str = "dataset"
    affixes: Affixes = Affixes()

    def __post_init__(self) -> None:
        check_choice("format", self.form, ("index", "colour"))


@dataclass(frozen=True)
class PredictionReader:
    """Reads predictions of one format in terms of the classes of a data set.

    Attributes:
        classes: K names.
        colours: K colours of the data set.
        options: what the user states.
    """

    classes: tuple[str, ...]
    colours: Sequence[Colour]
    options: FormatOptions = FormatOptions()

    @cached_property
    def known(self) -> NDArray[np.int32]:
        """The colour of each class as one number; InputError for a file without colours."""
        palette, colours = self.options.palette, list(self.colours)
        if palette != "dataset":
            content = read_yaml(Path(palette).expanduser())
            colours = content.get("palette", []) if isinstance(content, dict) else []
        try:
            return packed(np.array(colours, np.uint8).reshape(-1, 3))[: len(self.classes)]
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"palette={palette}: expected the key palette with a list of [red, green, blue], 0 "
                f"to 255, in the order of the class index ({error})."
            ) from error

    @cached_property
    def class_of_colour(self) -> Array:
        """The class of each of 2^24 colours, or `UNKNOWN`."""
        table = np.full(2**24, UNKNOWN, np.uint8)
        table[self.known] = np.arange(len(self.known))
        return table

    def read(self, path: Path) -> Array:
        """Class indices (H, W) uint8, all below K.

        Raises:
            InputError: not readable, another format than stated, or an unknown index or colour.
        """
        if self.options.form == "colour":
            if len(set(self.known.tolist())) < len(self.known):
                palette = self.options.palette
                raise InputError(f"palette={palette}: two classes have one colour; save indices.")
            rgb = read_colours(path)
            found = self.class_of_colour[packed(rgb)]
            if (wrong := found == UNKNOWN).any():
                raise InputError(
                    f"{path}: {int(wrong.sum())} pixels have the colour of no class, such as "
                    f"{rgb[wrong][0].tolist()}; name the palette with palette=FILE.yaml, or set "
                    "format=index if the stored numbers are classes."
                )
            return found
        image, bits = opened(path)
        if image.format != "PNG" or (image.mode, bits) != ("L", 8) and image.mode != "P":
            raise InputError(
                f"{path}: format=index expects a PNG of one channel of 8 bits, got {image.format} "
                f"of mode {image.mode} and {bits} bits; set format=colour if colours are classes."
            )
        indices = np.array(image, np.uint8)
        last = len(self.classes) - 1
        if (wrong := indices > last).any():
            raise InputError(
                f"{path}: {int(wrong.sum())} pixels are {int(indices[wrong][0])}, which is no "
                f"class; expected 0 to {last} ({self.classes[last]}) at every pixel."
            )
        if image.mode == "P" and self.options.palette == "dataset":
            self._check_palette(indices, np.array(image.convert("RGB")), path)
        return indices

    def _check_palette(self, indices: Array, rgb: Array, path: Path) -> None:
        """Refuse indices that are shown in colours of other classes of the data set."""
        shown = self.class_of_colour[packed(rgb)]
        wrong = (shown != UNKNOWN) & (shown != indices)
        if wrong.any():
            number, colour = int(indices[wrong][0]), int(shown[wrong][0])
            raise InputError(
                f"{path}: index {number} ({self.classes[number]}) is shown in the colour of "
                f"{self.classes[colour]}. Set format=colour if the colours are classes; or name "
                "the palette of the method with palette=FILE.yaml if the indices are."
            )


def packed(rgb: Array) -> NDArray[np.int32]:
    """(..., 3) colours as one number each, 0 .. 2^24 - 1."""
    red, green, blue = np.moveaxis(rgb.astype(np.int32), -1, 0)
    return np.asarray(red << 16 | green << 8 | blue)


def prediction_paths(folder: Path, names: Iterable[str], affixes: Affixes) -> dict[str, Path]:
    """Name of an image -> the file of its prediction, whether it exists or not."""
    return {name: folder / f"{affixes.file_stem(name)}.png" for name in names}
