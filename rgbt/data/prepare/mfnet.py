"""Files of a download of MFNet: the lists, their files, and lists by time of day."""

from __future__ import annotations

from collections.abc import Callable

from rgbt.checks import InputError
from rgbt.data.mfnet_layout import FOLDERS, SPLITS, base_name, either_layout
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.download import SourceFile, SourceFiles
from rgbt.data.prepare.plans import Download, Preparation, base_of, lists_in, text_of

TIMES = {"D": "day", "N": "night"}
"""Time of day by the last letter of a name."""


def plan_mfnet(download: Download) -> list[Item]:
    """The lists and their files, and lists of day and night if there are none.

    Raises:
        InputError: no folders of images and labels, no list, or files that a list names and that
            are not there.
    """
    entries = download.source.entries
    base, layout = _base(download.source)
    lists = lists_in(download.lists or download.source, "" if download.lists else base, SPLITS)
    if not lists:
        where = download.lists.path if download.lists else download.source.path / base
        raise InputError(
            f"{'lists' if download.lists else 'source'}: there is none of "
            f"{', '.join(SPLITS.values())} in {where}; give the folder that holds these "
            "lists with lists=..."
        )
    names = {name: entry for entry in lists.values() for name in entry.lines()}
    wanted = {f"{folder}/{name}.png": name for folder in FOLDERS[layout] for name in names}
    missing = [path for path in wanted if base + path not in entries]
    if missing:
        raise InputError(
            f"source: {len(missing)} files that lists name are not in {download.source.path}; the "
            f"first is {base}{missing[0]}, of {names[wanted[missing[0]]]}. Download the rest, or "
            "give shorter lists with lists=..."
        )
    items = [Item(path, entries[base + path]) for path in wanted]
    items += [Item(target, entry) for target, entry in lists.items()]
    return items + _by_time(lists)


def _base(source: SourceFiles) -> tuple[str, str]:
    """The folder that holds MFNet, and its layout."""

    def layout_in(has: Callable[[str], bool]) -> str | None:
        return next((name for name, each in FOLDERS.items() if all(map(has, each))), None)

    base = base_of(source, lambda has: layout_in(has) is not None, f"{either_layout()} of MFNet")
    layout = layout_in(lambda inner: base + inner in source.folders())
    assert layout is not None, "the folder was chosen for it"
    return base, layout


def _by_time(lists: dict[str, SourceFile]) -> list[Item]:
    """Lists of days and nights of the test list, by the letters, if there is neither."""
    test = SPLITS["test"]
    targets = {letter: SPLITS[f"test_{time}"] for letter, time in TIMES.items()}
    if test not in lists or not set(targets.values()).isdisjoint(lists):
        return []
    names = lists[test].lines()
    letters = [base_name(name)[-1:] for name in names]
    if not set(letters) <= set(TIMES):
        return []
    return [
        Item(
            target, text_of(name for name, its in zip(names, letters, strict=True) if its == letter)
        )
        for letter, target in targets.items()
        if letter in letters
    ]


PREPARATION = Preparation(plan_mfnet, r"ir_seg_dataset.*\.zip", ("lists",))
