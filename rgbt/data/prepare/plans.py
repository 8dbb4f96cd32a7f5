"""Plan which files of a download a data set requires, and their new paths.

Part of `rgbt.data.prepare`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path, PurePosixPath
from typing import NamedTuple

from rgbt.checks import InputError
from rgbt.data import freiburg_layout as freiburg
from rgbt.data import kp_layout as kp
from rgbt.data import mfnet, pst900_layout
from rgbt.data.file_dataset import FileDataset
from rgbt.data.folder.frames import Patterns
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import IMAGES, KP, LABELS
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.download import SourceFile, SourceFiles
from rgbt.data.pst900 import PST900

DEPTH = 3
"""Levels of folders in which a data set is searched, including the folder of the archive."""


class Download(NamedTuple):
    """The arguments of the command.

    Attributes:
        source: the download.
        labels: contains the labels if the download does not.
        lists: contains the lists if the download does not.
    """

    source: SourceFiles
    labels: SourceFiles | None = None
    lists: SourceFiles | None = None


class Preparation(NamedTuple):
    """How a data set is prepared.

    Attributes:
        reader: of the new folder.
        plan: files to write, from a download.
        archives: pattern of the names of archives that are opened inside a folder.
        options: optional arguments that apply: "labels", "lists".
    """

    reader: Callable[[str], FileDataset]
    plan: Callable[[Download], list[Item]]
    archives: str
    options: tuple[str, ...] = ()


def plan_mfnet(download: Download) -> list[Item]:
    """The lists and their files, and lists of day and night if there are none.

    Raises:
        InputError: no folders of images and labels, no list, or files that a list names and that
            are not there.
    """
    entries = download.source.entries
    base = _base_of(
        download.source, [set(each) for each in mfnet.FOLDERS.values()], mfnet.EITHER_LAYOUT
    )
    folders = download.source.folders()
    layout = next(
        name for name, each in mfnet.FOLDERS.items() if folders >= {base + word for word in each}
    )
    lists = _lists_in(download, base, mfnet.SPLITS)
    names = {name: entry for entry in lists.values() for name in entry.lines()}
    wanted = {f"{folder}/{name}.png": name for folder in mfnet.FOLDERS[layout] for name in names}
    missing = [path for path in wanted if base + path not in entries]
    if missing:
        raise InputError(
            f"source: {len(missing)} listed files are not in {download.source.path}; the first is "
            f"{base}{missing[0]}, of {names[wanted[missing[0]]]}. Download the missing files, or "
            "give shorter lists with lists=..."
        )
    items = [Item(path, entries[base + path]) for path in wanted]
    items += [Item(target, entry) for target, entry in lists.items()]
    by_time = {"D": mfnet.SPLITS["test_day"], "N": mfnet.SPLITS["test_night"]}
    test = lists[mfnet.SPLITS["test"]].lines() if mfnet.SPLITS["test"] in lists else ()
    letters = {mfnet.time_of(name) for name in test}
    if set(by_time.values()).isdisjoint(lists) and letters <= set(by_time):
        items += [
            Item(target, _text_of(name for name in test if mfnet.time_of(name) == letter))
            for letter, target in by_time.items()
            if letter in letters
        ]
    return items


def plan_pst900(download: Download) -> list[Item]:
    """RGB, thermal images and labels of both parts; InputError without train/rgb and test/rgb."""
    parts = pst900_layout.PARTS
    base = _base_of(
        download.source, [{f"{part}/rgb"} for part in parts], "train/rgb or test/rgb of PST900"
    )
    folders = {f"{base}{part}/{kind}" for part in parts for kind in pst900_layout.FOLDERS}
    return [
        Item(path.removeprefix(base), entry)
        for path, entry in download.source.entries.items()
        if path.rpartition("/")[0] in folders and path.endswith(".png")
    ]


FREIBURG_FILES = {
    "train": re.compile(
        rf"(?:^|/)(seq_[^/]*)/([^/]+)/"
        rf"({freiburg.RGB}|{freiburg.THERMAL}|{freiburg.LABEL})/([^/]+\.png)$",
        re.IGNORECASE,
    ),
    "test": re.compile(
        rf"(?:^|/)test(?:/[^/]+)?/(day|night)/"
        rf"({freiburg.TEST_RGB}|{freiburg.TEST_THERMAL}|{freiburg.TEST_LABEL})"
        r"/([^/]+\.(?:png|npy))$",
        re.IGNORECASE,
    ),
}


def plan_freiburg(download: Download) -> list[Item]:
    """RGB images, aligned thermal images and labels of the training and of the test archive.

    Raises:
        InputError: neither part is there, or two files would become one.
    """
    found: dict[str, SourceFile] = {}
    for path, entry in download.source.entries.items():
        for part, pattern in FREIBURG_FILES.items():
            match = pattern.search(path)
            if match is not None:
                _add_once(found, "/".join([part, *match.groups()]), entry)
    if not found:
        raise InputError(
            f"source: {download.source.path} holds neither train/seq_*/*/{freiburg.RGB} nor "
            f"test/day/{freiburg.TEST_RGB} of Freiburg Thermal; give the folder that holds "
            "train.zip and test.zip, or one of these archives."
        )
    return [Item(target, entry) for target, entry in found.items()]


KP_LABEL = re.compile(r"(?:^|/)(set\d\d_V\d{3}_I\d{5})\.png$")
BY_HAND = re.compile(r"(?:^|/)(?:val_day|val_night)/[^/]+$")
"""Labels drawn by hand in MS-UDA; its other folders contain those of a network."""

KP_IMAGES = {
    "the CRM release": re.compile(r"(?:^|/)(set\d\d)/(V\d{3})/(visible|lwir)/(I\d{5})\.jpg$"),
    "MS-UDA": re.compile(r"(?:^|/)(set\d\d)_(V\d{3})_(visible|lwir)_(I\d{5})\.png$"),
}
"""Paths of images in a download, by the layout that they get; KAIST's own is that of CRM."""


def plan_kp(download: Download) -> list[Item]:
    """Labels, the two images of each, and lists as the CRM release has them.

    KAIST has 95 thousand pairs, KP labels of 950 of them; nothing else is copied. Lists are made by
    set numbers; lists of `download.lists` are copied instead, with their images.

    Raises:
        InputError: no labels, a name that is none of KAIST, labels or images that are not there.
    """
    labels = _kp_labels(download.labels or download.source)
    by_list: dict[str, tuple[SourceFile | bytes, list[str]]] = {}
    if download.lists is None:
        for split, target in kp.SPLITS.items():
            names = sorted(name for name in labels if kp.set_of(name) in kp.sets_of(split))
            if names:
                by_list[target] = (_text_of(f"{name}.png" for name in names), names)
    else:
        for target, entry in _lists_in(download, "", kp.SPLITS).items():
            names = [kp.MODALITY.sub("_", line.removesuffix(".png")) for line in entry.lines()]
            wrong = [name for name in names if kp.NAME.fullmatch(name) is None]
            if wrong:
                raise InputError(
                    f"lists: '{wrong[0]}' in {entry} is not {kp.FORM}; correct the line."
                )
            by_list[target] = (entry, names)
    wanted = dict.fromkeys(name for _, names in by_list.values() for name in names)
    without = [name for name in wanted if name not in labels]
    if without:
        raise InputError(
            f"lists: {len(without)} names have no label in "
            f"{(download.labels or download.source).path}, the first is {without[0]}. Give all "
            "labels, or shorter lists."
        )
    return [
        *(Item(f"labels/{name}.png", labels[name]) for name in wanted),
        *_kp_images(download.source, tuple(wanted)),
        *(Item(target, content) for target, (content, _) in by_list.items()),
    ]


def _kp_labels(source: SourceFiles) -> dict[str, SourceFile]:
    """Name -> label; only those drawn by hand if there are folders of them."""
    files = [path for path in source.entries if KP_LABEL.search(path)]
    found: dict[str, SourceFile] = {}
    for path in [path for path in files if BY_HAND.search(path)] or files:
        name = PurePosixPath(path).stem
        if kp.NAME.fullmatch(name) is None:
            raise InputError(
                f"{source.key}: {source.entries[path]} is not {kp.FORM}; move it out of the folder."
            )
        _add_once(found, name, source.entries[path])
    if not found:
        raise InputError(
            f"{source.key}: there is no label such as set00_V000_I00050.png in {source.path}. "
            "KAIST itself has no labels; give those of MS-UDA with labels=..."
        )
    return found


def _kp_images(source: SourceFiles, names: tuple[str, ...]) -> list[Item]:
    """The images of `names`, all of one layout; InputError if one is missing."""
    found: dict[str, SourceFile] = {}
    for layout, expression in KP_IMAGES.items():
        patterns = Patterns.of(*IMAGES[layout][:2], LABELS[layout])
        targets: dict[tuple[str, str], Path] = {}
        for name in names:
            values = dict(zip(("set", "video", "frame"), name.split("_"), strict=True))
            values["time"] = kp.LABELS_OF[kp.is_night(name)]
            frame = patterns.frame(Path(), name, values)
            targets |= {(name, "visible"): frame.rgb, (name, "lwir"): frame.thermal}
        for path, entry in source.entries.items():
            match = expression.search(path)
            key = (f"{match[1]}_{match[2]}_{match[4]}", match[3]) if match else ("", "")
            if key in targets:
                _add_once(found, str(targets[key]), entry)
        if found:
            break
    missing = [str(path) for path in targets.values() if str(path) not in found]
    if missing:
        raise InputError(
            f"source: {len(missing)} of the {len(targets)} images with labels are not in "
            f"{source.path}; the first is {missing[0].partition('/')[2]}; download the rest of "
            "KAIST (set00 to set11), or give fewer labels."
        )
    return [Item(target, entry) for target, entry in found.items()]


def _lists_in(download: Download, base: str, splits: Mapping[str, str]) -> dict[str, SourceFile]:
    """Name of a list -> the list; InputError if there is none."""
    source, base = (download.lists, "") if download.lists else (download.source, base)
    found = {
        name: source.entries[base + name]
        for name in splits.values()
        if base + name in source.entries
    }
    if not found:
        raise InputError(
            f"{source.key}: {source.path / base} contains none of the lists "
            f"{', '.join(splits.values())}; give the folder of the lists with lists=..."
        )
    return found


def _text_of(names: Iterable[str]) -> bytes:
    return "".join(f"{name}\n" for name in names).encode()


def _add_once(found: dict[str, SourceFile], key: str, entry: SourceFile) -> None:
    """Add the file that becomes `key`; InputError if there are two."""
    if key in found:
        raise InputError(
            f"{found[key]} and {entry} would both be {key}; move one of them out of the download."
        )
    found[key] = entry


def _base_of(source: SourceFiles, layouts: list[set[str]], what: str) -> str:
    """Prefix of the paths in the one folder of least depth that holds the folders of a layout.

    `what` is the expected content, for the message.
    """
    folders = source.folders()
    bases = ["" if folder == "" else f"{folder}/" for folder in folders]
    fitting = [
        base
        for base in sorted(bases, key=lambda base: (base.count("/"), base))
        if base.count("/") <= DEPTH
        and any(folders >= {base + inner for inner in layout} for layout in layouts)
    ]
    best = [base for base in fitting if base.count("/") == fitting[0].count("/")]
    if not best:
        raise InputError(
            f"source: {source.path} does not contain the folders {what}, and neither do its "
            "folders; give the downloaded archive, or the folder into which it was unpacked."
        )
    if len(best) > 1:
        raise InputError(
            f"source: {source.path} contains {what} several times ({', '.join(best)}); give one "
            "of these folders."
        )
    return best[0]


PREPARATIONS = {
    "mfnet": Preparation(mfnet.MFNet, plan_mfnet, r"ir_seg_dataset.*\.zip", ("lists",)),
    "pst900": Preparation(PST900, plan_pst900, r"pst900.*\.zip"),
    "kp": Preparation(KP, plan_kp, r"(set\d\d|.*labels.*)\.zip", ("labels", "lists")),
    "freiburg": Preparation(Freiburg, plan_freiburg, r"(train|test)\.zip"),
}
"""Data set -> how it is prepared."""
