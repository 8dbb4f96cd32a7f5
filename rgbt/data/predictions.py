"""Read predicted label images written by any method, in the format that the user states.

A PNG holds class indices in one channel (`rgbt predict` and most releases write these), or shows
the colours of a palette, with or without indices of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.files import open_indices, values_of
from rgbt.data.labels import LabelCodes, code_of
from rgbt.files.yaml_files import read_yaml

Array = NDArray[np.uint8]
Colour = tuple[int, int, int]
Format = Literal["index", "colour"]

# Ending of the pictures that `rgbt predict` writes beside its predictions.
OVERLAY = "_overlay"


@dataclass(frozen=True)
class PredictionReader:
    """Reads predictions of one format in terms of the K `classes` of a data set, of K `colours`.

    `format`: "index": the stored numbers are classes; "colour": the colours shown are. `palette`:
    of the data set, or of a YAML file with that key, such as a file of conf/dataset. `prefix` and
    `suffix` are before and after the name of an image in the name of its prediction.
    """

    classes: tuple[str, ...]
    colours: Sequence[Colour]
    format: Format = "index"
    palette: str = "dataset"
    prefix: str = ""
    suffix: str = ""

    def __post_init__(self) -> None:
        check_choice("format", self.format, ("index", "colour"))

    @cached_property
    def known(self) -> tuple[int, ...]:
        """Return the colour of each class as one number; InputError for a file without colours."""
        palette, colours = self.palette, cast(Any, self.colours)
        if palette != "dataset":
            content = read_yaml(Path(palette).expanduser())
            colours = content.get("palette") if isinstance(content, dict) else None
        try:
            codes = code_of(np.array(colours, np.uint8).reshape(len(colours), 3))
        except (TypeError, ValueError, OverflowError) as error:
            raise InputError(
                f"palette={palette}: expected the key palette with a list of [red, green, blue], 0 "
                f"to 255, in the order of the class index ({error})."
            ) from error
        return tuple(codes[: len(self.classes)].tolist())

    @cached_property
    def codes(self) -> LabelCodes:
        """Return the class of each stored number or colour; InputError for two of one colour."""
        if self.format == "index":
            return LabelCodes({index: index for index in range(len(self.classes))})
        if len(set(self.known)) < len(self.known):
            raise InputError(f"palette={self.palette}: two classes have one colour; save indices.")
        codes = {code: index for index, code in enumerate(self.known)}
        return LabelCodes(codes, f"palette={self.palette}", of_colours=True)

    def path(self, folder: Path, name: str) -> Path:
        """Return the file of the prediction of an image, whether it exists or not."""
        return folder / f"{self.prefix}{name}{self.suffix}.png"

    def read(self, path: Path) -> Array:
        """Read class indices (H, W) uint8, all below K.

        Raises:
            InputError: not readable, another format than stated, or an unknown index or colour.
        """
        if self.format == "colour":
            return self.codes.read(path)
        image = open_indices(path)
        raw = values_of(image)
        if raw.dtype != np.uint8:
            raise InputError(f"{path}: expected one channel of 8 bits, got mode {image.mode}.")
        found = self.codes.classes(raw, path)
        if image.mode == "P" and self.palette == "dataset":
            # Refuse indices that are shown in colours of other classes of the data set.
            palette = code_of(np.reshape(image.getpalette("RGB") or [], (-1, 3))).tolist()
            shown = {index: palette[index] for index in np.unique(found) if index < len(palette)}
            for index, code in shown.items():
                if code in self.known and code != self.known[index]:
                    colour = self.classes[self.known.index(code)]
                    raise InputError(
                        f"{path}: index {index} ({self.classes[index]}) is shown in the colour of "
                        f"{colour}. Set format=colour if the colours are classes; or name the "
                        "palette of the method with palette=FILE.yaml if the indices are."
                    )
        return found
