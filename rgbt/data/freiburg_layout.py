"""The files of each frame of the Freiburg Thermal archives; nothing is opened here."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from rgbt.checks import InputError

RGB, THERMAL, LABEL = "fl_rgb", "fl_ir_aligned", "fl_rgb_labels"
"""Folders of a training sequence, and prefixes of the names of their files."""

TEST_RGB, TEST_THERMAL, TEST_LABEL = "ImagesRGB", "ImagesIR", "SegmentationClass"
"""Folders of the test part; their case differs between copies and is ignored."""


class FreiburgFrame(NamedTuple):
    """One pair of images and its label.

    Attributes:
        name: without slashes: "seq_00_day_00_<seconds>_<nanoseconds>", "test_night_<...>_<...>".
        part: its folder: "train/seq_00_day/00", "test/night".
        stamp: seconds and nanoseconds in the name of the RGB file.
        night: by the path.
        rgb: existing file.
        thermal: expected file.
        label: expected file; None for training frames at night.
    """

    name: str
    part: str
    stamp: str
    night: bool
    rgb: Path
    thermal: Path
    label: Path | None

    @property
    def is_test(self) -> bool:
        """Whether it is of the hand-labelled part."""
        return self.part.startswith("test/")

    @property
    def sequences(self) -> tuple[str, str]:
        """The training sequence, and the piece of it: "seq_00_day", "seq_00_day/00"."""
        _, sequence, *piece = self.part.split("/")
        return sequence, "/".join([sequence, *piece])


def find_frames(root: Path) -> tuple[FreiburgFrame, ...]:
    """Every frame with an RGB image: training sequences, test by day, test by night.

    In a folder frames are sorted by file name, so that the order is the same everywhere.

    Raises:
        InputError: a folder without a time of day, two frames of one name, or two RGB images with
            one thermal image.
    """
    frames = [*_training(inside(root, "train")), *_test(inside(root, "test"))]
    names: set[str] = set()
    for frame in frames:
        if frame.name in names:
            raise InputError(
                f"{frame.rgb}: there is another frame called '{frame.name}'; remove one of them."
            )
        names.add(frame.name)
    return tuple(frames)


def unused_files(root: Path, frames: tuple[FreiburgFrame, ...]) -> tuple[Path, ...]:
    """Thermal images and labels that no frame of `find_frames` names, sorted."""
    used = {path for frame in frames for path in (frame.thermal, frame.label)}
    train, test = inside(root, "train"), inside(root, "test")
    folders = [inside(piece, word) for piece in _pieces(train) for word in (THERMAL, LABEL)]
    folders += [
        inside(inside(test, time), word)
        for time in ("day", "night")
        for word in (TEST_THERMAL, TEST_LABEL)
    ]
    found = [path for folder in folders for path in _files(folder, (".png", ".npy"))]
    return tuple(path for path in found if path not in used)


def inside(parent: Path, word: str) -> Path:
    """The folder `word` of `parent`, ignoring case; `parent / word` if there is none."""
    alike = [path for path in _folders(parent) if path.name.lower() == word.lower()]
    return alike[0] if alike else parent / word


def _folders(parent: Path) -> list[Path]:
    if not parent.is_dir():
        return []
    return sorted(
        path for path in parent.iterdir() if path.is_dir() and not path.name.startswith(".")
    )


def _files(folder: Path, endings: tuple[str, ...]) -> list[Path]:
    if not folder.is_dir():
        return []
    found = (path for path in folder.iterdir() if path.suffix in endings)
    return sorted(path for path in found if not path.name.startswith("."))


def _pieces(train: Path) -> Iterator[Path]:
    for sequence in _folders(train):
        yield from _folders(sequence)


def _training(train: Path) -> Iterator[FreiburgFrame]:
    for piece in _pieces(train):
        sequence = piece.parent.name
        night = _at_night(piece.parent)
        thermals, labels = inside(piece, THERMAL), inside(piece, LABEL)
        for rgb in _files(inside(piece, RGB), (".png",)):
            stamp = rgb.stem.removeprefix(f"{RGB}_")
            if stamp == rgb.stem:
                continue
            yield FreiburgFrame(
                name=f"{sequence}_{piece.name}_{stamp}",
                part=f"train/{sequence}/{piece.name}",
                stamp=stamp,
                night=night,
                rgb=rgb,
                thermal=thermals / f"{THERMAL}_{stamp}.png",
                label=None if night else labels / f"{LABEL}_{stamp}.png",
            )


def _at_night(sequence: Path) -> bool:
    words = [word for word in ("day", "night") if word in sequence.name.lower()]
    if len(words) != 1:
        raise InputError(
            f"{sequence}: expected a name of a sequence with day or night, such as seq_00_day; "
            "rename the folder, or move it out of the training part."
        )
    return words == ["night"]


def _test(test: Path) -> Iterator[FreiburgFrame]:
    for time in ("day", "night"):
        folder = inside(test, time)
        thermals = _by_stamp(inside(folder, TEST_THERMAL), "_ir", ".png")
        labels = _by_stamp(inside(folder, TEST_LABEL), "_rgb", ".npy")
        partners: dict[Path, Path] = {}
        for rgb in _files(inside(folder, TEST_RGB), (".png",)):
            stamp = rgb.stem.removesuffix("_rgb")
            # Stamps of RGB and label end in the number of the frame in its burst, always 0. Stamps
            # of thermal images do so in one part of the archive only.
            thermal = thermals.get(stamp) or thermals.get(stamp.removesuffix("0"))
            thermal = thermal or inside(folder, TEST_THERMAL) / f"{stamp}_ir.png"
            if thermal in partners:
                raise InputError(
                    f"{rgb} and {partners[thermal]} would both have {thermal} as their thermal "
                    "image; remove or rename the wrong one."
                )
            partners[thermal] = rgb
            yield FreiburgFrame(
                name=f"test_{time}_{stamp}",
                part=f"test/{time}",
                stamp=stamp,
                night=time == "night",
                rgb=rgb,
                thermal=thermal,
                label=labels.get(stamp) or inside(folder, TEST_LABEL) / f"{stamp}_rgb.npy",
            )


def _by_stamp(folder: Path, ending: str, suffix: str) -> dict[str, Path]:
    return {path.stem.removesuffix(ending): path for path in _files(folder, (suffix,))}
