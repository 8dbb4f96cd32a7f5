"""Folders, split lists and names of MFNet; nothing is opened here."""

from __future__ import annotations

FOLDERS = {"packed": ("images", "labels"), "folders": ("RGB", "Thermal", "Label")}
"""Folders of each layout; the last one holds the labels."""

SPLITS = {split: f"{split}.txt" for split in ("train", "val", "test", "test_day", "test_night")}

MIRRORED = "_flip"
"""Suffix of the names of mirrored copies, which some copies of the data set contain."""


def base_name(name: str) -> str:
    """`name` without the suffix of mirrored copies: "00001D_flip" -> "00001D"."""
    return name.removesuffix(MIRRORED)


def either_layout() -> str:
    """The folders of both layouts, for messages."""
    return " or ".join("+".join(folders) for folders in FOLDERS.values())
