"""Find pairs of files in a folder of new images, by the layouts of a data set.

A folder is read by the first layout of which it has a complete pair; other files are named.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from rgbt.checks import InputError
from rgbt.data.files import channels, decode
from rgbt.data.folder.pattern import NO_VALUES, PathMatch, Pattern, WordValues, in_order, what_is_in
from rgbt.data.images import PairPattern

KINDS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp")
"""Suffixes of image files, in lower case; thermal images may also be .npy."""

PLAIN = (
    PairPattern("rgb/{name}.png", "thermal/{name}.png"),
    PairPattern("{name}.png", "{name}.png"),
)
"""Layouts accepted for every data set; suffixes may be any of `KINDS`."""

KEY = "input"


class NewPair(NamedTuple):
    """Two files and the name of their sample; the same file twice if thermal is its channel 4."""

    name: str
    rgb: Path
    thermal: Path


class NewImages(NamedTuple):
    """Content of a folder.

    Attributes:
        pairs: in the order of their names, 9 before 10.
        alone: RGB image without a thermal image -> expected path of the latter.
        others: images that belong to no pair and are not labels.
    """

    pairs: tuple[NewPair, ...]
    alone: dict[Path, Path]
    others: tuple[Path, ...]


def find_pairs(folder: Path, layouts: Sequence[PairPattern], name: str) -> NewImages:
    """The pairs in the existing `folder`.

    The layouts of the data set `name` are tried from its root, then from the folders inside it
    (without their first pieces), then `PLAIN`. Case is ignored. Other suffixes than those of a
    layout are used only if its own give no pair.

    Raises:
        InputError: no complete pair, two of one name, or two thermal images for one RGB image.
    """
    tiers, inner = [], list(layouts)
    while inner:
        tiers.append(inner)
        inner = [shorter for each in inner if (shorter := _inside(each)) is not None]
    alone: dict[Path, Path] = {}
    for tier in (*tiers, *([plain] for plain in PLAIN)):
        for any_kind in (False, True):
            found = _in_tier(folder, tier, any_kind=any_kind)
            if found.pairs:
                return found
            alone = alone or found.alone
    reason = f"{folder} holds {what_is_in(folder)}"
    for rgb, thermal in list(alone.items())[:1]:
        reason = (
            f"the thermal image of {rgb} would be {thermal}, but {thermal.parent} holds "
            f"{what_is_in(thermal.parent)}"
        )
    raise InputError(
        f"{KEY}={folder} holds no pair of images: {reason}. Expected the files of {name} "
        f"({'; '.join(map(str, layouts))}; also without the first folders), folders rgb and "
        "thermal with equal names, or PNG files of four channels (red, green, blue, thermal). To "
        "predict a single pair, use rgb=FILE thermal=FILE instead of input."
    )


def _inside(layout: PairPattern) -> PairPattern | None:
    """The layout relative to its first folder; None if RGB and thermal have different ones."""
    first, _, rgb = layout.rgb.partition("/")
    other, _, thermal = layout.thermal.partition("/")
    if first != other or "{" not in rgb or "{" not in thermal:
        return None
    if not set(Pattern(thermal, KEY).words) <= set(Pattern(rgb, KEY).words):
        return None
    of_label, _, label = (layout.label or "").partition("/")
    return PairPattern(rgb, thermal, label if of_label == first and "{" in label else None)


def _in_tier(folder: Path, layouts: Sequence[PairPattern], *, any_kind: bool) -> NewImages:
    pairs: dict[Path, NewPair] = {}
    alone: dict[Path, Path] = {}
    labels: set[Path] = set()
    for layout in layouts:
        labels |= {path for path, _ in _files(layout.label, folder, any_kind=True)}
        rgb = Pattern(layout.rgb, KEY)
        candidates = dict(_files(layout.rgb, folder, any_kind=any_kind))
        is_packed = layout.rgb == layout.thermal
        if is_packed and not all(map(_has_four_channels, list(candidates)[:1])):
            continue
        for path in candidates.keys() - pairs.keys():
            values = candidates[path]
            thermal = path if is_packed else _partner(layout, folder, values, any_kind=any_kind)
            if thermal is None:
                alone[path] = Pattern(layout.thermal, KEY).path(folder, values)
            else:
                pairs[path] = NewPair("_".join(values[each] for each in rgb.words), path, thermal)
    partners = {pair.thermal for pair in pairs.values() if pair.thermal != pair.rgb} | labels
    named: dict[str, NewPair] = {}
    for pair in (pairs[path] for path in sorted(pairs) if path not in partners):
        if pair.name in named:
            raise InputError(
                f"{KEY}: {named[pair.name].rgb} and {pair.rgb} would both be called "
                f"'{pair.name}'; rename or move one of them."
            )
        named[pair.name] = pair
    used = {*pairs, *partners}
    every = sorted(
        path
        for path in (folder.rglob("*") if named else ())
        if path.suffix.lower() in KINDS and not path.name.startswith(".")
    )
    return NewImages(
        tuple(named[name] for name in sorted(named, key=in_order)),
        {path: alone[path] for path in sorted(alone) if path not in used},
        tuple(path for path in every if path not in {*used, *alone}),
    )


def _files(
    text: str | None, folder: Path, values: WordValues = NO_VALUES, *, any_kind: bool
) -> Iterator[PathMatch]:
    """Images whose paths match `text`, or match it except for the suffix."""
    if text is None:
        return
    stem, dot, ending = text.rpartition(".")
    kinds = (ending, *(kind[1:] for kind in (*KINDS, ".npy"))) if any_kind and dot else (ending,)
    for kind in dict.fromkeys(kinds):
        yield from Pattern(f"{stem}{dot}{kind}", KEY).files(folder, values, any_case=True)


def _partner(
    layout: PairPattern, folder: Path, values: WordValues, *, any_kind: bool
) -> Path | None:
    """The thermal image of an RGB image; an exact match of the name is preferred."""
    exact = Pattern(layout.thermal, KEY).path(folder, values)
    found = list(dict(_files(layout.thermal, folder, values, any_kind=any_kind)))
    if exact in found or not found:
        return exact if found else None
    if len(found) > 1:
        raise InputError(
            f"{KEY}={folder}: {found[0]} and {found[1]} could both be the thermal image of one "
            "pair; remove or rename one of them."
        )
    return found[0]


def _has_four_channels(path: Path) -> bool:
    try:
        return channels(decode(path)) == 4
    except InputError:  # reading it raises this error again
        return True
