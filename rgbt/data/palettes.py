"""The palettes that predictions may be painted in: the data set's, published ones, the user's.

Published palettes are data: `palettes.yaml`. NAME-bgr is a palette with red and blue exchanged, as
``cv2.imwrite`` writes RGB colours.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from rgbt.checks import InputError, nearest
from rgbt.files.yaml_files import read_yaml

Colour = tuple[int, int, int]
FILE = Path(__file__).with_name("palettes.yaml")
OWN = "dataset"
"""Name of the palette of the data set."""

EXCHANGED = "-bgr"
"""Ending of the name of a palette with red and blue exchanged."""


@dataclass(frozen=True)
class Palette:
    """Colours of the first classes.

    Attributes:
        name: as typed by the user.
        colours: (red, green, blue), 0..255, in the order of the class index.
    """

    name: str
    colours: tuple[Colour, ...]

    @property
    def exchanged(self) -> Palette:
        """The same with red and blue exchanged."""
        swapped = tuple((blue, green, red) for red, green, blue in self.colours)
        return Palette(f"{self.name}{EXCHANGED}", swapped)

    @property
    def description(self) -> str:
        """What it is, for a sentence."""
        name = self.name.removesuffix(EXCHANGED)
        what = "dataset.palette" if name == OWN else f"the palette {name}"
        return what + (" with red and blue exchanged" if name != self.name else "")

    def classes(self, num_classes: int) -> dict[Colour, int]:
        """Colour -> class, of the first `num_classes` classes.

        Raises:
            InputError: two classes have one colour.
        """
        found: dict[Colour, int] = {}
        for index, colour in enumerate(self.colours[:num_classes]):
            if colour in found:
                raise InputError(
                    f"{self.description} gives the classes {found[colour]} and {index} the same "
                    f"colour {colour}, so a colour does not identify a class; save predictions as "
                    "indices."
                )
            found[colour] = index
        return found


def possible_palettes(own: Palette, num_classes: int) -> tuple[Palette, ...]:
    """The palette of the data set, those published for as many classes, and all exchanged."""
    published = (
        Palette(name, colours)
        for name, (classes, colours) in _published().items()
        if classes in (None, num_classes)
    )
    return tuple(each for one in (own, *published) for each in (one, one.exchanged))


def palette_named(text: str, own: Palette) -> Palette:
    """The palette that the user names.

    Args:
        text: "dataset", a name of `palettes.yaml`, one of these with "-bgr", or a YAML file with
            the key ``palette``, such as a file of conf/dataset.
        own: the palette of the data set.

    Raises:
        InputError: no such name or file, or a file without colours.
    """
    if text.endswith((".yaml", ".yml")):
        content = read_yaml(Path(text).expanduser())
        return Palette(text, _colours(content, f"palette={text}"))
    known = {OWN: own, **{name: Palette(name, each) for name, (_, each) in _published().items()}}
    name = text.removesuffix(EXCHANGED)
    if name not in known:
        raise InputError(
            f"palette={text}: {nearest(name, list(known))}; or give a YAML file with the key "
            f"palette. {EXCHANGED} after a name exchanges red and blue."
        )
    return known[name] if name == text else known[name].exchanged


@cache
def _published() -> dict[str, tuple[int | None, tuple[Colour, ...]]]:
    """Name -> number of classes that it is for, None for any; and colours."""
    return {
        name: (each["classes"], _colours(each, f"{FILE.name}: {name}"))
        for name, each in read_yaml(FILE).items()
    }


def _colours(content: Any, where: str) -> tuple[Colour, ...]:
    rows = content.get("palette") if isinstance(content, dict) else None
    if not isinstance(rows, list) or not rows or not all(map(_is_colour, rows)):
        raise InputError(
            f"{where}: expected the key palette with a list of [red, green, blue], 0 to 255, in "
            "the order of the class index."
        )
    return tuple((red, green, blue) for red, green, blue in rows)


def _is_colour(row: Any) -> bool:
    return (
        isinstance(row, list)
        and len(row) == 3
        and all(type(value) is int and 0 <= value <= 255 for value in row)
    )
