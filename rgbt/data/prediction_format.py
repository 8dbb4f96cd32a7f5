"""Recognise the format of the predictions of a method, from all of its files together.

A file shows a class by its stored number, by its colour, or by both (a palette PNG). A reading of
the files is one of the stored numbers or one of a palette. The files are read where every reading
that fits them gives the same classes. Where two differ, the user has to choose, because only the
user knows what the method wrote: PASCAL VOC's palette has colours of MFNet at other indices.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.palettes import OWN, Colour, Palette, palette_named, possible_palettes
from rgbt.data.prediction_files import Affixes
from rgbt.data.prediction_images import Kind, PredictionReader, decode, packed, read_header

Format = Literal["auto", "index", "colour"]

MOST_COLOURS = 256
"""Colours that one file of predictions may have; more are in a photograph or a blended picture."""

NO_INDEX = 255
"""Index of a pixel whose three channels differ."""


@dataclass(frozen=True, kw_only=True)
class FormatOptions:
    """What the user says about the files of predictions.

    Attributes:
        form: "index": the stored numbers; "colour": the colours that a viewer shows; "auto": by
            the files.
        palette: of the colours, see `rgbt.data.palettes.palette_named`; "auto": the one that fits.
        affixes: of the names of the files, see `rgbt.data.prediction_files.find_affixes`.
    """

    form: Format = "auto"
    palette: str = "auto"
    affixes: Affixes = Affixes()

    def __post_init__(self) -> None:
        check_choice("format", self.form, get_args(Format))


class RecognisedFormat(NamedTuple):
    """The reader of the files, and one sentence about their format."""

    reader: PredictionReader
    sentence: str


class _Shown(NamedTuple):
    """How a pixel states its class: the stored number, and the colour of a viewer."""

    number: int
    colour: Colour


_Meaning = Mapping[_Shown, int]
"""What is shown -> its class, as one reading gives it."""


def recognise_format(
    paths: Iterable[Path],
    classes: tuple[str, ...],
    colours: tuple[Colour, ...],
    options: FormatOptions = FormatOptions(),  # noqa: B008 - frozen
) -> RecognisedFormat:
    """The format of predictions, which are read twice: here, and when they are counted.

    Args:
        paths: of all files of a method.
        classes: K names.
        colours: K colours of the data set.
        options: see `FormatOptions`.

    Raises:
        InputError: files of several kinds, no PNG files, an unknown or ambiguous palette, overlays.
    """
    paths, own = list(paths), Palette(OWN, colours)
    if options.form == "index":
        if options.palette != "auto":
            raise InputError(f"palette={options.palette} has no effect with format=index; omit it.")
        return RecognisedFormat(PredictionReader(classes), "Read as class indices (format=index).")
    kind = "colours" if options.form == "colour" else one_kind(paths)
    if kind == "one channel":
        if options.palette != "auto":
            raise InputError(
                f"palette={options.palette} has no effect on PNGs with one channel, whose values "
                "are class indices; omit it, or set format=colour for the grey levels shown."
            )
        return RecognisedFormat(PredictionReader(classes), "Read as class indices (one channel).")
    if options.palette != "auto":
        palette = palette_named(options.palette, own)
        sentence = f"Read as colours of {palette.description} (palette={options.palette})."
        return RecognisedFormat(PredictionReader(classes, palette), sentence)
    shown = _shown(paths)
    meanings = {
        palette: _by_colour(shown, palette, len(classes))
        for palette in possible_palettes(own, len(classes))
    }
    readings = {each: found for each, found in meanings.items() if len(found) == len(shown)}
    indices = None if options.form == "colour" else _by_index(shown, len(classes))
    if kind == "a palette":
        return _of_palette_images(shown, readings, indices, classes)
    if not readings and indices is not None:
        sentence = "Read as class indices (three equal channels)."
        return RecognisedFormat(PredictionReader(classes), sentence)
    # Without a palette that fits, the reader of the one with most of the colours refuses a file.
    palette = next(iter(readings), max(meanings, key=lambda each: len(meanings[each])))
    _check_unambiguous(shown, readings, indices, classes)
    sentence = f"Read as RGB images in the colours of {palette.description}."
    return RecognisedFormat(PredictionReader(classes, palette), sentence)


def one_kind(paths: Iterable[Path]) -> Kind:
    """The kind of all files, before any of them is decoded.

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
    return next(iter(seen), "one channel")


def _shown(paths: Iterable[Path]) -> dict[_Shown, Path]:
    """What the pixels show -> the first file that does so."""
    found: dict[_Shown, Path] = {}
    for path in paths:
        rgb = decode(path, "RGB")
        indices = decode(path)
        if indices.ndim == 3:
            is_grey = (rgb == rgb[..., :1]).all(-1)
            indices = np.where(is_grey, rgb[..., 0], NO_INDEX).astype(np.uint8)
        both = packed(rgb).astype(np.int64) | indices.astype(np.int64) << 24
        values = _distinct(both.ravel()).tolist()
        if len(values) > MOST_COLOURS:
            raise InputError(
                f"{path} holds {len(values):,} colours, as an image or a prediction blended with "
                "one; give the label images that the method wrote, without smoothing."
            )
        for value in values:
            colour = (value >> 16 & 255, value >> 8 & 255, value & 255)
            found.setdefault(_Shown(value >> 24, colour), path)
    return found


def _distinct(values: NDArray[np.int64]) -> NDArray[np.int64]:
    """The different values; neighbours are mostly equal, so that few of them are sorted."""
    changes = np.flatnonzero(values[1:] != values[:-1]) + 1
    return np.unique(np.append(values[:1], values[changes]))


def _by_colour(shown: Iterable[_Shown], palette: Palette, num_classes: int) -> dict[_Shown, int]:
    """The classes by the colours of a palette, of what it has a colour for."""
    known = palette.classes(num_classes)
    return {each: known[each.colour] for each in shown if each.colour in known}


def _by_index(shown: Iterable[_Shown], num_classes: int) -> dict[_Shown, int] | None:
    """The classes by the stored numbers; None where one is no class."""
    found = {each: each.number for each in shown}
    return found if max(found.values(), default=0) < num_classes else None


def _of_palette_images(
    shown: Mapping[_Shown, Path],
    readings: Mapping[Palette, _Meaning],
    indices: _Meaning | None,
    classes: tuple[str, ...],
) -> RecognisedFormat:
    agreeing = [palette for palette, meaning in readings.items() if meaning == indices]
    if indices is not None and agreeing and len(agreeing) == len(readings):
        sentence = (
            f"Read as indices of palette PNGs, shown in the colours of {agreeing[0].description}."
        )
        return RecognisedFormat(PredictionReader(classes), sentence)
    advice = (
        "choose one reading: format=index (the stored numbers) or format=colour (the colours shown)"
    )
    wrong = next((each for each in shown if each.number >= len(classes)), None)
    if wrong is not None:
        raise InputError(
            f"{shown[wrong]}: palette index {wrong.number} is no class, but the data set has only "
            f"the classes 0 to {len(classes) - 1}; {advice}."
        )
    for palette, meaning in readings.items():
        for each, index in meaning.items():
            if index != each.number:
                raise InputError(
                    f"{shown[each]}: palette index {each.number} is shown as {each.colour}, the "
                    f"colour of {classes[index]} in {palette.description}, but index {each.number} "
                    f"is {classes[each.number]}; {advice}."
                )
    first = next(iter(shown.items()))
    raise InputError(
        f"{first[1]}: the colours of this palette PNG are those of no known palette; {advice}, or "
        "name the palette with palette=FILE.yaml."
    )


def _check_unambiguous(
    shown: Mapping[_Shown, Path],
    readings: Mapping[Palette, _Meaning],
    indices: _Meaning | None,
    classes: tuple[str, ...],
) -> None:
    """Refuse RGB images that two readings give different classes."""
    possible = {f"palette={palette.name}": meaning for palette, meaning in readings.items()}
    if indices is not None:
        possible["format=index"] = indices
    for way, meaning in possible.items():
        first_way, first = next(iter(possible.items()))
        each = next((one for one in shown if meaning[one] != first[one]), None)
        if each is not None:
            raise InputError(
                f"{shown[each]}: colour {each.colour} is {classes[first[each]]} with {first_way} "
                f"and {classes[meaning[each]]} with {way}, and both fit all predictions; choose "
                "one of them."
            )
