"""Parse names, split lists and label folders of KP; a name contains recording, video and frame.

The recording decides time of day and split. Nothing is opened here.
"""

from __future__ import annotations

import re

from rgbt.checks import InputError

SETS = {"train": (0, 1, 2, 3, 4, 5), "val": (6, 10), "test": (7, 8, 9, 11)}
"""Recordings of each split, as the lists of the CRM release divide the labelled images."""

NIGHT_SETS = (3, 4, 5, 9, 10, 11)
TIMES = ("day", "night")
SPLITS = {
    split: f"{split}.txt"
    for base in SETS
    for split in (base, *(f"{base}_{time}" for time in TIMES))
}
NAME = re.compile(r"set(0\d|1[01])_V(\d{3})_I(\d{5})")
FORM = "a name such as set00_V000_I00050 with a set from 00 to 11"
MODALITY = re.compile("_(visible|lwir)_")
"""The modality in names of the lists of MS-UDA."""

LABELS_OF = {False: "val_day", True: "val_night"}
"""Folders of MS-UDA, by whether they hold nights."""


def set_of(name: str) -> int:
    """Number of the recording of `name`; InputError if the name is invalid."""
    return int(parts_of(name)[0].removeprefix("set"))


def is_night(name: str) -> bool:
    """Whether `name` was recorded at night, by its set; InputError if the name is invalid."""
    return set_of(name) in NIGHT_SETS


def sets_of(split: str) -> tuple[int, ...]:
    """Recordings of `split`, one of `SPLITS`, when no list is used."""
    base, _, time = split.partition("_")
    return tuple(
        number for number in SETS[base] if not time or (number in NIGHT_SETS) == (time == "night")
    )


def parts_of(name: str) -> tuple[str, str, str]:
    """Set, video and frame, as ("set00", "V000", "I00050"); InputError if it is invalid."""
    if NAME.fullmatch(name) is None:
        raise InputError(
            f"'{name}' is not {FORM}, so its files and its time of day are unknown; correct the "
            "name."
        )
    recording, video, frame = name.split("_")
    return recording, video, frame
