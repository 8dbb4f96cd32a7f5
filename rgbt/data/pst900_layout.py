"""Folders, parts and names of PST900; nothing is opened here."""

from __future__ import annotations

import re

FOLDERS = ("rgb", "thermal", "labels")
PARTS = ("train", "test")
SPLITS = ("train", "val", "test")

BAG = re.compile(r"(?:^|_)bag(\d+)_")
"""The recording of an image: 58_bag21_rect_rgb_frame0000000440 is from bag 21."""


def bag_of(name: str) -> int | None:
    """Number of the recording in `name`; None if there is none."""
    match = BAG.search(name)
    return int(match[1]) if match else None
