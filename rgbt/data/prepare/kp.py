"""Files of the KAIST download that have labels of KP, and their splits.

KAIST has 95 thousand pairs, KP labels of 950 of them; nothing else is copied. Part of
`rgbt.data.prepare`.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import PurePosixPath
from typing import NamedTuple

from rgbt.checks import InputError
from rgbt.data import kp_layout as kp
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.download import SourceFile, SourceFiles
from rgbt.data.prepare.plans import Download, Preparation, add_once, lists_in, text_of

KINDS = ("visible", "lwir")
IMAGE = re.compile(r"(?:^|/)(set\d\d)/(V\d{3})/(visible|lwir)/(I\d{5})\.jpg$")
"""Path of an image of KAIST, also in the CRM release."""

FLAT_IMAGE = re.compile(r"(?:^|/)(set\d\d)_(V\d{3})_(visible|lwir)_(I\d{5})\.png$")
"""Path of an image of MS-UDA."""

Target = Callable[[str, str], str]
"""(name, kind) -> path of an image in the new folder."""

LABEL = re.compile(r"(?:^|/)(set\d\d_V\d{3}_I\d{5})\.png$")
BY_TIME = re.compile(r"(?:^|/)(?:val_day|val_night)/[^/]+$")
"""Labels drawn by hand in MS-UDA; its other folders contain those of a network."""


def plan_kp(download: Download) -> list[Item]:
    """Labels, the two images of each, and lists as the CRM release has them.

    Lists are made by set numbers; lists of `download.lists` are copied instead, with their images.

    Raises:
        InputError: no labels, a name that is none of KAIST, labels or images that are not there.
    """
    labels = _labels(download.labels or download.source)
    lists = _lists_by_set(labels) if download.lists is None else _lists_of(download.lists)
    names = tuple(dict.fromkeys(name for each in lists.values() for name in each.names))
    target, images = _images(download.source, set(names))
    targets = [target(name, kind) for name in names for kind in KINDS]
    _check_labels(download, [name for name in names if name not in labels])
    _check_images(download, [each for each in targets if each not in images], len(targets))
    items = [Item(f"labels/{name}.png", labels[name]) for name in names]
    items += [Item(each, images[each]) for each in targets]
    return items + [Item(target, each.content) for target, each in lists.items()]


class _List(NamedTuple):
    """A list to be written, and its names."""

    content: SourceFile | bytes
    names: tuple[str, ...]


def _labels(source: SourceFiles) -> dict[str, SourceFile]:
    """Name -> label; only those drawn by hand if there are folders of them."""
    files = [path for path in source.entries if LABEL.search(path)]
    by_hand = [path for path in files if BY_TIME.search(path)]
    found: dict[str, SourceFile] = {}
    for path in by_hand or files:
        name = PurePosixPath(path).stem
        if kp.NAME.fullmatch(name) is None:
            raise InputError(
                f"{source.key}: {source.entries[path]} is not {kp.FORM}; move it away."
            )
        add_once(found, name, source.entries[path])
    if not found:
        raise InputError(
            f"{source.key}: there is no label such as set00_V000_I00050.png in {source.path}; "
            "KAIST itself has none, give those of MS-UDA with labels=..."
        )
    return found


def _lists_by_set(labels: dict[str, SourceFile]) -> dict[str, _List]:
    lists = {}
    for split, target in kp.SPLITS.items():
        sets = kp.sets_of(split)
        names = tuple(sorted(name for name in labels if kp.set_of(name) in sets))
        if names:
            lists[target] = _List(text_of(f"{name}.png" for name in names), names)
    return lists


def _lists_of(source: SourceFiles) -> dict[str, _List]:
    lists = {}
    for target, entry in lists_in(source, "", kp.SPLITS).items():
        names = tuple(kp.MODALITY.sub("_", line.removesuffix(".png")) for line in entry.lines())
        for name in names:
            if kp.NAME.fullmatch(name) is None:
                raise InputError(f"lists: '{name}' in {entry} is not {kp.FORM}; correct the line.")
        lists[target] = _List(entry, names)
    if not lists:
        raise InputError(
            f"lists: there is none of {', '.join(kp.SPLITS.values())} in {source.path}; give the "
            "folder that holds them, or leave lists out to divide the images by set numbers."
        )
    return lists


def _images(source: SourceFiles, names: set[str]) -> tuple[Target, dict[str, SourceFile]]:
    """The target of an image, and target -> file of the images of `names`; all of one form."""
    for pattern, target in ((IMAGE, _as_kaist), (FLAT_IMAGE, _as_ms_uda)):
        found: dict[str, SourceFile] = {}
        for path, entry in source.entries.items():
            match = pattern.search(path)
            if match and (name := f"{match[1]}_{match[2]}_{match[4]}") in names:
                add_once(found, target(name, match[3]), entry)
        if found:
            return target, found
    return _as_kaist, {}


def _as_kaist(name: str, kind: str) -> str:
    recording, video, frame = kp.parts_of(name)
    return f"images/{recording}/{video}/{kind}/{frame}.jpg"


def _as_ms_uda(name: str, kind: str) -> str:
    recording, video, frame = kp.parts_of(name)
    return f"pseudo_KP/{kp.LABELS_OF[kp.is_night(name)]}/{recording}_{video}_{kind}_{frame}.png"


def _check_labels(download: Download, missing: list[str]) -> None:
    if missing:
        raise InputError(
            f"lists: {len(missing)} names have no label in "
            f"{(download.labels or download.source).path}, the first is {missing[0]}; give all "
            "labels, or shorter lists."
        )


def _check_images(download: Download, missing: list[str], num_images: int) -> None:
    if missing:
        raise InputError(
            f"source: {len(missing)} of the {num_images} images that belong to labels are not in "
            f"{download.source.path}, the first is {missing[0].partition('/')[2]}; download the "
            "rest of KAIST (set00 to set11), or give fewer labels."
        )


PREPARATION = Preparation(plan_kp, r"(set\d\d|.*labels.*)\.zip", ("labels", "lists"))
