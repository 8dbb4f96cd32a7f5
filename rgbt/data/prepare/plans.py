"""Which files of a download are wanted, and where they belong, for each data set.

A plan names what `rgbt.data.mfnet`, `pst900`, `kp` and `freiburg` read and nothing else. Part of
`rgbt.data.prepare`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple

from rgbt.checks import InputError
from rgbt.data import freiburg_layout as freiburg
from rgbt.data import mfnet, pst900
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.source import Entry, Source

DEPTH = 3
"""How many folders deep a data set is looked for, that of the archive's own name included."""

TIMES = {"D": "day", "N": "night"}
"""What the last letter of a name of MFNet says."""


class Given(NamedTuple):
    """What the command was given.

    Attributes:
        source: the download.
        labels: where labels are, if not there.
        lists: where lists are, if not there.
    """

    source: Source
    labels: Source | None = None
    lists: Source | None = None


def plan_mfnet(given: Given) -> list[Item]:
    """What the lists name, the lists, and lists of day and night where there are none.

    Raises:
        InputError: no folders of images and labels, no list, or files that a list names and that
            are not there.
    """
    entries = given.source.entries
    base, layout = _mfnet_base(given.source)
    lists = lists_in(given.lists or given.source, "" if given.lists else base, mfnet.SPLITS)
    if not lists:
        where = given.lists.path if given.lists else given.source.path / base
        raise InputError(
            f"{'lists' if given.lists else 'source'}: there is none of "
            f"{', '.join(mfnet.SPLITS.values())} in {where}; give the folder that holds these "
            "lists with lists=..."
        )
    names = {name: entry for entry in lists.values() for name in entry.lines()}
    wanted = {f"{folder}/{name}.png": name for folder in mfnet.LAYOUTS[layout] for name in names}
    missing = [path for path in wanted if base + path not in entries]
    if missing:
        raise InputError(
            f"source: {len(missing)} files that lists name are not in {given.source.path}; the "
            f"first is {base}{missing[0]}, of {names[wanted[missing[0]]]}. Download the rest, or "
            "give shorter lists with lists=..."
        )
    items = [Item(path, entries[base + path]) for path in wanted]
    items += [Item(target, entry) for target, entry in lists.items()]
    return items + _by_time(lists)


def plan_pst900(given: Given) -> list[Item]:
    """RGB, thermal images and labels of both parts.

    Raises:
        InputError: no folder that holds train/rgb or test/rgb.
    """
    base = _base(
        given.source,
        lambda has: any(has(f"{part}/{pst900.FOLDERS[0]}") for part in pst900.PARTS),
        "train/rgb or test/rgb of PST900",
    )
    folders = {f"{base}{part}/{kind}" for part in pst900.PARTS for kind in pst900.FOLDERS}
    return [
        Item(path.removeprefix(base), entry)
        for path, entry in given.source.entries.items()
        if path.rpartition("/")[0] in folders and path.endswith(".png")
    ]


FREIBURG_TRAIN = re.compile(
    rf"(?:^|/)(seq_[^/]*)/([^/]+)/({freiburg.RGB}|{freiburg.THERMAL}|{freiburg.LABEL})/([^/]+\.png)$",
    re.IGNORECASE,
)
FREIBURG_TEST = re.compile(
    rf"(?:^|/)test(?:/[^/]+)?/(day|night)/"
    rf"({freiburg.TEST_RGB}|{freiburg.TEST_THERMAL}|{freiburg.TEST_LABEL})/([^/]+\.(?:png|npy))$",
    re.IGNORECASE,
)


def plan_freiburg(given: Given) -> list[Item]:
    """RGB images, aligned thermal images and labels of the training and of the test archive.

    Raises:
        InputError: neither part is there, or two files would become one.
    """
    found: dict[str, Entry] = {}
    for path, entry in given.source.entries.items():
        for part, pattern in (("train", FREIBURG_TRAIN), ("test", FREIBURG_TEST)):
            match = pattern.search(path)
            if match is not None:
                add_once(found, "/".join([part, *match.groups()]), entry)
    if not found:
        raise InputError(
            f"source: {given.source.path} holds neither train/seq_*/*/{freiburg.RGB} nor "
            f"test/day/{freiburg.TEST_RGB} of Freiburg Thermal; give the folder that holds "
            "train.zip and test.zip, or one of these archives."
        )
    return [Item(target, entry) for target, entry in found.items()]


def lists_in(source: Source, base: str, splits: Mapping[str, str]) -> dict[str, Entry]:
    """Name of a list -> the list, of those that lie in the folder `base` of `source`."""
    return {
        name: source.entries[base + name]
        for name in splits.values()
        if base + name in source.entries
    }


def text_of(names: Iterable[str]) -> bytes:
    """A list, one name per line."""
    return "".join(f"{name}\n" for name in names).encode()


def add_once(found: dict[str, Entry], key: str, entry: Entry) -> None:
    """Note the file that becomes `key`; InputError where there are two."""
    if key in found:
        raise InputError(
            f"{found[key]} and {entry} would both be {key}; move one of them out of the download."
        )
    found[key] = entry


def _base(source: Source, holds: Callable[[Callable[[str], bool]], bool], what: str) -> str:
    """Beginning of the paths in the one folder of least depth that `holds` says is the right one.

    Args:
        source: the download.
        holds: gets whether a folder of some name is inside.
        what: it should hold, for the message.
    """
    folders = source.folders()
    bases = ["" if folder == "" else f"{folder}/" for folder in folders]
    fitting = sorted(
        (base.count("/"), base)
        for base in bases
        if base.count("/") <= DEPTH and holds(lambda inner, base=base: base + inner in folders)  # type: ignore[misc]
    )
    best = [base for depth, base in fitting if depth == fitting[0][0]]
    if not best:
        raise InputError(
            f"source: {source.path} does not hold the folders {what}, nor does one of the folders "
            "in it; give the downloaded archive, or the folder into which it was unpacked."
        )
    if len(best) > 1:
        raise InputError(
            f"source: {source.path} holds {what} several times ({', '.join(best)}); give one of "
            "these folders."
        )
    return best[0]


def _mfnet_base(source: Source) -> tuple[str, str]:
    """The folder that holds MFNet, and its layout."""

    def layout_in(has: Callable[[str], bool]) -> str | None:
        return next((name for name, each in mfnet.LAYOUTS.items() if all(map(has, each))), None)

    either = " or ".join("+".join(folders) for folders in mfnet.LAYOUTS.values())
    base = _base(source, lambda has: layout_in(has) is not None, f"{either} of MFNet")
    layout = layout_in(lambda inner: base + inner in source.folders())
    assert layout is not None, "the folder was chosen for it"
    return base, layout


def _by_time(lists: dict[str, Entry]) -> list[Item]:
    """Lists of the day and of the night of the test list, by the letters, if neither is there."""
    test = mfnet.SPLITS["test"]
    targets = {letter: mfnet.SPLITS[f"test_{time}"] for letter, time in TIMES.items()}
    if test not in lists or not set(targets.values()).isdisjoint(lists):
        return []
    names = lists[test].lines()
    letters = [mfnet.base_name(name)[-1:] for name in names]
    if not set(letters) <= set(TIMES):
        return []
    return [
        Item(
            target, text_of(name for name, its in zip(names, letters, strict=True) if its == letter)
        )
        for letter, target in targets.items()
        if letter in letters
    ]
