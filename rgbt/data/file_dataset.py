"""The base class of data sets that read each image and label from a separate file."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.files import read_names, read_packed, stored_hw, within
from rgbt.data.images import PairReader, check_size
from rgbt.data.labels import LabelCodes
from rgbt.data.patterns import FrameFiles, Patterns
from rgbt.data.thermal import (
    MOST_IMAGES,
    Range,
    ThermalRange,
    found_range,
    kind_of,
    mixed,
    points_of,
    unit_and_limits,
)
from rgbt.requirements import DatasetRecord
from rgbt.types import Sample

# Split -> its list file, or several, whose names are all in the split.
Lists = Mapping[str, str | tuple[str, ...]]

# Beginning of the name of a list that comes with rgbt, and where these lists are.
OURS, LISTS = "rgbt:", Path(__file__).with_name("lists")

# Ends of the names of splits that are parts of another, "train_day" of "train".
DAY_OR_NIGHT = ("_day", "_night")

# Split -> names, of the splits whose names could be read.
SplitNames = Mapping[str, tuple[str, ...]]

Whole = tuple[NDArray[np.uint8], NDArray[Any], NDArray[np.uint8] | None]


class FileDataset:
    """Reads files, never resizes, augments or remaps them, and refuses inexact content.

    A subclass defines `frame` and `nights`, and sets the attributes below. Its arguments are the
    keys of its file in conf/dataset, which describes each; InputError: no such root, another
    layout, or settings that do not fit each other.

    Attributes:
        images: how its images, and new ones of any folder, are read.
        codes: the meaning of label values.
        patterns: of the paths of its files.
        splits: split -> its list, or the pattern of its files; several lists are joined by "+".
        files_of: split -> its lists, where they are more than one.
        splits_key: setting that names the splits, for messages.
        mirrored: suffix of the names of mirrored copies, which only training splits may list.
    """

    images: PairReader
    codes: LabelCodes
    patterns: Patterns
    splits: dict[str, str]
    files_of: Mapping[str, tuple[str, ...]] = {}
    splits_key = "dataset.splits"
    mirrored: str | None = None

    def __init__(  # noqa: PLR0913 - settings of every data set
        self,
        root: str,
        name: str,
        num_classes: int,
        classes: tuple[str, ...],
        palette: tuple[tuple[int, int, int], ...],
        *,
        background: tuple[str, ...],
        unscored: tuple[str, ...] = (),
    ) -> None:
        self.root = Path(root).expanduser()
        if not self.root.is_dir():
            raise InputError(f"dataset.root: no such folder: {root}")
        for key, values in (("classes", classes), ("palette", palette)):
            if len(values) != num_classes:
                raise InputError(
                    f"dataset.num_classes is {num_classes} but dataset.{key} has {len(values)} "
                    "entries; both numbers must be equal."
                )
        self.name, self.num_classes = name, num_classes
        self.classes, self.palette = classes, palette
        self.check_classes(unscored=unscored, background=background)
        self.unscored, self.background = unscored, background
        self._names: dict[str, tuple[str, ...]] = {}

    @property
    def record(self) -> DatasetRecord:
        """State the number of its classes, and what the first one is."""
        first = self.classes[0] in self.background
        return DatasetRecord(
            num_classes=self.num_classes, first_class="background" if first else "object"
        )

    def check_classes(self, **settings: tuple[str, ...]) -> None:
        """Refuse settings that name what is not one of its classes (InputError)."""
        for key, chosen in settings.items():
            for word in chosen:
                check_choice(f"dataset.{key}", word, self.classes)

    def follow(
        self, rgb: str, thermal: str, label: str | None, setting: ThermalRange | None
    ) -> None:
        """Read images by the patterns of a user's configuration; InputError for invalid ones."""
        unit, limits = unit_and_limits(setting)
        self.patterns = Patterns.of(rgb, thermal, label)
        self.images = PairReader(
            layouts=(self.patterns._replace(label=None),),
            thermal_range=None if limits == "auto" else limits,
            unit=unit,
            find_range=self._found_range if limits == "auto" else None,
            advice="dataset.thermal with the pattern of dataset.rgb reads a fourth channel as "
            "thermal; values that are no grey levels of 8 bits require dataset.thermal_range="
            "[low, high], the values that become black and white",
        )

    def settle_range(self, found: Range | None) -> Range | None:
        """Return the thermal range that `auto` found, and use `found` instead if it is given.

        None where the setting is not `auto`. InputError: no image of the split train is readable.
        """
        if self.images.find_range is None:
            return None
        if found is not None:
            self.images = replace(self.images, thermal_range=found, find_range=None)
        return self.images.chosen_range

    def _found_range(self) -> Range:
        """Return percentiles of thermal values of the split train; InputError: values of a mix."""
        images, errors = {}, []
        for name in evenly_spaced(self.names("train"), MOST_IMAGES):
            try:
                rgb, thermal = (within(path, self.root) for path in self.frame(name)[2:4])
                stored = read_packed(rgb, "")[1] if rgb == thermal else self.images.values(thermal)
                values = self.images.cut(stored, name)
            except InputError as error:  # one of many: the training reports it
                errors.append(str(error))
            else:
                images[name] = kind_of(values), points_of(values)
        if not images:
            raise InputError(f"dataset.thermal_range=auto: {errors[0]}")
        unlike = mixed(images, self.images.unit)
        if unlike:
            what = f"{len(unlike)} of {len(images)} training images, first '{unlike[0][0]}'"
            raise InputError(f"dataset.thermal_range=auto: {what}: {unlike[0][1]}")
        return found_range(np.stack([points for _, points in images.values()]), self.images.unit)

    def listed(self, split: str) -> tuple[str, ...]:
        """Return the names of a known split; () if there are none, InputError if unreadable."""
        return self.lines(split)

    def use_lists(self, lists: Lists) -> None:
        """Read the names of every split from its list or lists."""
        self.splits, files_of = {}, {}
        for split, files in lists.items():
            if isinstance(files, str):
                self.splits[split] = files
            else:
                self.splits[split] = "+".join(files)
                files_of[split] = files
        self.files_of = files_of

    def lines(self, split: str) -> tuple[str, ...]:
        """Return lines of the lists of a split, files below the root or anywhere; () without one.

        ``rgbt:NAME`` is a list that comes with rgbt (``rgbt/data/lists``).

        InputError: of several lists one is missing, or two have a line in common.
        """
        key = f"{self.splits_key}.{split}"
        files = self.files_of.get(split, (self.splits[split],))
        paths = []
        for file in files:
            ours = LISTS / file.removeprefix(OURS)
            paths.append(ours if file.startswith(OURS) else self.root / Path(file).expanduser())
        if len(paths) == 1 and not os.path.lexists(paths[0]):
            return ()
        found = [name for path in paths for name in read_names(path, key)]
        if len(paths) > 1 and len(set(found)) < len(found):
            twice = next(name for name in found if found.count(name) > 1)
            raise InputError(f"{key}: '{twice}' is more than once in {self.splits[split]}.")
        return tuple(found)

    def check_split(self, split: str) -> None:
        """Refuse a split that is not one of `splits`."""
        if split not in self.splits:
            raise InputError(
                f"{self.splits_key} has no split '{split}'; {nearest(split, self.splits)}."
            )

    def has(self, split: str) -> bool:
        """Say whether any sample of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        if split not in self._names:
            self._names[split] = self.listed(split)
        return bool(self._names[split])

    def names(self, split: str) -> tuple[str, ...]:
        """Return the names of a split, in order; InputError if it is unknown, missing or empty."""
        if not self.has(split):
            raise InputError(
                f"split '{split}' of {self.name} is empty: expected "
                f"{self.splits.get(split, 'nothing')} in {self.root}."
            )
        return self._names[split]

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`; InputError if there can be no such frame."""
        raise NotImplementedError

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Say which images were taken at night; None if the data set does not state it."""
        raise NotImplementedError

    def files(self, name: str) -> tuple[Path, ...]:
        """Return every file that `read` opens: RGB, thermal (if it has its own), label (if any)."""
        return tuple(dict.fromkeys(path for path in self.frame(name)[2:] if path is not None))

    def read(self, name: str) -> Sample:
        """Read sample `name`: rgb (H, W, 3), thermal (H, W), label (H, W) or None, all uint8.

        Raises:
            InputError: no such name, a file is missing, leads out of the root, cannot be decoded,
                has other channels, bits or size than expected, or the label holds a value that has
                no meaning.
        """
        return self.made(name, self.whole(name))

    def whole(self, name: str) -> Whole:
        """Read RGB (H, W, 3), thermal values and label (H, W); InputError as of `read`."""
        frame = self.frame(name)
        rgb, thermal = (within(path, self.root) for path in frame[2:4])
        label = self.codes.read(within(frame.label, self.root)) if frame.label else None
        hw = None if label is None else label.shape
        pixels, values = self.images.whole(name, rgb, thermal, hw)
        label = None if label is None else self.fitted(label, frame, values.shape)
        return pixels, values, label

    def made(self, name: str, whole: Whole) -> Sample:
        """Make the sample of what `whole` returns; InputError as of `read`."""
        pixels, values, label = whole
        if label is not None:
            label = np.ascontiguousarray(self.images.cut(label, name))
        sample = self.images.sample(name, pixels, values, self.frame(name).thermal)
        return replace(sample, label=label)

    def pair(self, name: str) -> Sample:
        """Read the images of `read` alone, without the label; InputError as there."""
        return self.images.read(name, *(within(path, self.root) for path in self.frame(name)[2:4]))

    def unaligned(self, name: str) -> tuple[NDArray[np.uint8], NDArray[Any]]:
        """Read whole RGB (H, W, 3) and thermal values (H', W'); InputError as of `read`."""
        return self.images.unaligned(*(within(path, self.root) for path in self.frame(name)[2:4]))

    def stored_hw(self, name: str) -> tuple[int, int]:
        """Return (height, width) of `read`, by the header of the RGB image; InputError without."""
        if self.images.crop is None:
            return stored_hw(within(self.frame(name).rgb, self.root))
        top, bottom, left, right = self.images.crop
        return bottom - top, right - left

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """Read the label of `read` alone, (H, W) uint8, or None; InputError as there."""
        path = self.frame(name).label
        return None if path is None else self.codes.read(within(path, self.root))

    def fitted(
        self, label: NDArray[np.uint8], frame: FrameFiles, hw: tuple[int, ...]
    ) -> NDArray[np.uint8]:
        """Return the label of a whole frame of this size, not cut; InputError if it cannot fit."""
        check_size(hw, "its label", label, frame.name, frame.label)
        return label

    def decoding(self) -> dict[str, Any]:
        """Return the settings that change what `read` makes of the files."""
        return {
            "codes": sorted(self.codes.codes.items()),
            "layouts": [str(layout) for layout in self.images.layouts],
            "thermal_range": self.images.limits,
            "most_tint": self.images.most_tint,
            "crop": self.images.crop,
        }

    def fingerprint(self) -> str:
        """Return `hash_of_files` of all splits; those that are not there are empty."""
        return hash_of_files({split: self.listed(split) for split in self.splits}, self.files)

    def repeats(self, split: str) -> bool:
        """Say whether a split only repeats images of other splits, and need not exist."""
        return split.endswith(DAY_OR_NIGHT)

    def unused(self, lists: SplitNames) -> Collection[Path]:
        """Return files of the layout that belong to no image of a split."""
        found: set[Path] = set()
        for pattern in self.patterns:
            if pattern is not None:
                found.update(pattern.files(self.root))
        for name in {name for names in lists.values() for name in names}:
            found.difference_update(self.files(name))
        return found

    def own_problems(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Return further problems of names and files; no image is opened."""
        return []

    def own_notes(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Return further remarks."""
        return []


def evenly_spaced(names: Sequence[str], number: int) -> list[str]:
    """Take at most `number` of the names at equal distances, the first and the last included."""
    return [names[i] for i in np.linspace(0, len(names) - 1, min(number, len(names))).astype(int)]


def hash_of_files(splits: SplitNames, files: Callable[[str], Iterable[Path]]) -> str:
    """Return SHA-256 in hexadecimal over names of every split and sizes of their files.

    Nothing is decoded and folders are left out, so that equal copies have equal fingerprints.

    Args:
        splits: split -> its names; () where the split is not there.
        files: name -> its files; a missing file has size -1.
    """
    sizes: dict[str, list[int]] = {}
    digest = hashlib.sha256()
    for split in sorted(splits):
        digest.update(f"{split} {len(splits[split])}\n".encode())
        for name in splits[split]:
            if name not in sizes:
                sizes[name] = [size_of(path) for path in files(name)]
            digest.update(f"{name} {sizes[name]}\n".encode())
    return digest.hexdigest()


def size_of(path: Path) -> int:
    """Return the bytes of a file, -1 if it is missing."""
    # A path through a file instead of a folder is missing as well.
    try:
        return path.stat().st_size
    except (FileNotFoundError, NotADirectoryError):
        return -1
