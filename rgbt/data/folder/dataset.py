"""A user's own RGB-thermal data, described by one YAML file: paths, splits, label values.

A reader only: it maps values to classes and to grey levels as the configuration says, never resizes
or aligns, and refuses what it cannot read exactly. docs/datasets.md has a worked example.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.file_dataset import FileDataset
from rgbt.data.folder.frames import FolderFrame, check_partners, find_frames, patterns_of
from rgbt.data.folder.images import FolderImages
from rgbt.data.folder.pattern import SPLIT
from rgbt.data.folder.splits import FOLDERS, ByFolder, ByList, ByShare, SplitRule
from rgbt.data.folder.values import (
    LabelValue,
    Range,
    check_limits,
    each_colour,
    label_codes,
    painted,
)
from rgbt.data.images import PairPattern
from rgbt.data.named_files import existing_file, existing_root, hash_of_files
from rgbt.data.report.folder import FolderChecks
from rgbt.ranges import Colour, Names, NumClasses, Seed, Share, Text
from rgbt.types import Sample

Array = NDArray[np.uint8]


class Folder(FileDataset):
    """RGB-thermal pairs in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.folder.pattern`): {name}
    is the frame, {split} its split, {sequence} a group of consecutive frames, and any other word
    matches any text. The values of the words in the path of the RGB image, joined by "_", are the
    name of a sample; thermal image and label have the same values in their paths.

    Args:
        root: folder that the patterns are relative to.
        name: what the data set is called in messages and tables.
        num_classes: number of classes; other nodes of the configuration interpolate it.
        classes: their names, in order of the class index.
        rgb: pattern of the RGB images, 8 bit, three channels.
        thermal: pattern of the thermal images, one channel or three equal ones, of the size of the
            RGB image; the same as `rgb` for files of four channels R, G, B, thermal.
        label: pattern of the labels, images or `.npy`; None: the data set has no labels.
        palette: (red, green, blue) of each class, 0..255; None: those of `colours`, or colours
            that differ.
        unscored: classes that are counted but left out of every mean over classes.
        folders: split -> value of {split}; None: train, val and test.
        lists: split -> list file in `root`; replaces `folders`.
        shares: split -> share of the frames, 1 in total; replaces `folders`.
        shares_seed: seed of the draw of `shares`.
        block: number of consecutive frames that are drawn together; None: whole sequences.
        unlabelled: splits without labels; no label files are expected.
        ids: label value -> class; None: values are class indices.
        colours: class -> its colour in label images, or several; replaces `ids`.
        ignored: label values, or colours, that do not count.
        thermal_range: (low, high) thermal values that become black and white; None: 8 bit.
        night: pattern of the names of night images, with * and ?; None: unknown.

    Raises:
        InputError: no such root, patterns that match nothing, or invalid settings.
    """

    images: FolderImages

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        num_classes: NumClasses,
        classes: Names,
        rgb: Text,
        thermal: Text,
        label: Text | None,
        name: Text = "folder",
        palette: tuple[Colour, ...] | None = None,
        unscored: Names = (),
        folders: dict[Text, Text] | None = None,
        lists: dict[Text, Text] | None = None,
        shares: dict[Text, Share] | None = None,
        shares_seed: Seed = 0,
        block: Annotated[int, Interval(ge=1, le=10**6)] | None = None,
        unlabelled: Names = (),
        ids: dict[LabelValue, Text] | None = None,
        colours: dict[Text, Colour | tuple[Colour, ...]] | None = None,
        ignored: tuple[LabelValue | Colour, ...] = (),
        thermal_range: Range | None = None,
        night: Text | None = None,
    ) -> None:
        folder = existing_root(root, f"that dataset.rgb='{rgb}' begins in")
        palette = _palette(num_classes, classes, palette, colours)
        super().__init__(folder, name, num_classes, classes, palette)
        self.unscored = unscored
        self.thermal_range = thermal_range
        self.night = night
        for word in classes:
            if classes.count(word) > 1:
                raise InputError(f"dataset.classes: '{word}' occurs twice; rename one.")
        for word in unscored:
            check_choice("dataset.unscored", word, classes)
        check_limits(thermal_range)
        self.codes = label_codes(classes, ids, colours, ignored)
        self.patterns = patterns_of(rgb, thermal, label)
        self.images = FolderImages((PairPattern(rgb, thermal, label),), thermal_range)
        self.frames: Mapping[str, FolderFrame] = find_frames(self.root, self.patterns)
        self._rule = self._rule_of(folders, lists, shares, (shares_seed, block))
        self._names: dict[str, tuple[str, ...]] = {}
        self.unlabelled = unlabelled
        for split in unlabelled:
            check_choice("dataset.unlabelled", split, self.splits)
        # Without labelled splits these may be new images, of the day alone and without labels.
        if set(self.splits) - set(unlabelled):
            self._check_labels()
            self._check_night()

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its pattern, list or share."""
        return self._rule.splits

    def has(self, split: str) -> bool:
        """Whether any frame of `split` exists; InputError if the split is unknown."""
        self._check_split(split)
        return self._rule.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split: in the order of its list, or by their text and numbers."""
        self._check_split(split)
        if split not in self._names:
            self._names[split] = self._rule.names(split)
        return self._names[split]

    def pair(self, name: str) -> Sample:
        """The images of `read` alone, without the label; InputError as there."""
        frame = self.frame(name)
        rgb = self._there("RGB image", frame.rgb, name)
        return self.images.read(name, rgb, self._there("thermal image", frame.thermal, name))

    def label(self, name: str) -> Array | None:
        """The label of `read` alone, (H, W) uint8; None if the data set or the split has none."""
        frame = self.frame(name)
        if frame.label is None or name in self._without_labels:
            return None
        return self.codes.read(self._there("label", frame.label, name))

    def values(self, name: str) -> NDArray[Any]:
        """Values of the thermal camera before they are grey levels, (H, W); errors as of `read`."""
        frame = self.frame(name)
        path = self._there("thermal image", frame.thermal, name)
        return self.images.values(path, packed=self.packed)

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens for `name`: RGB, thermal and, where it has one, label."""
        frame = self.frame(name)
        label = None if name in self._without_labels else frame.label
        paths = (frame.rgb, frame.thermal, label)
        return tuple(dict.fromkeys(path for path in paths if path is not None))

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {
            "packed": self.packed,
            "thermal_range": self.thermal_range,
            "codes": sorted(self.codes.codes.items()),
            "of_colours": self.codes.of_colours,
            "num_classes": self.num_classes,
        }

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each name matches `night`; None if it is not given."""
        if self.night is None:
            return None
        return tuple(fnmatchcase(name, self.night) for name in names)

    def fingerprint(self) -> str:
        """SHA-256 in hexadecimal over `hash_of_files` and the meaning of label values."""
        listed = {
            split: tuple(name for name in self.names(split) if name in self.frames)
            if self.has(split)
            else ()
            for split in self.splits
        }
        meaning = json.dumps([sorted(self.codes.codes.items()), self.codes.of_colours])
        files = hash_of_files(listed, self.files)
        return hashlib.sha256(f"{meaning}\n{files}".encode()).hexdigest()

    def checks(self) -> FolderChecks:
        """What `rgbt.data.check` checks of this data set."""
        return FolderChecks(self)

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; InputError if there is no such frame."""
        if name not in self.frames:
            raise InputError(
                f"{self.name} ({self.root}) has no frame called '{name}': there is no such RGB "
                f"image (dataset.rgb='{self.patterns.rgb.text}'); restore it, or remove the name "
                "from the list."
            )
        return self.frames[name]

    @property
    def packed(self) -> bool:
        """Whether thermal is the fourth channel of the file of the RGB image."""
        return self.patterns.thermal.text == self.patterns.rgb.text

    @cached_property
    def _without_labels(self) -> frozenset[str]:
        present = [split for split in self.unlabelled if self.has(split)]
        return frozenset(name for split in present for name in self.names(split))

    def _check_labels(self) -> None:
        if self.patterns.label is not None:
            labelled = (
                frame for name, frame in self.frames.items() if name not in self._without_labels
            )
            check_partners(self.patterns.label, labelled, self.root)

    def _there(self, what: str, path: Path, name: str) -> Path:
        return existing_file(what, path, name, self.root)

    def _rule_of(
        self,
        folders: dict[str, str] | None,
        lists: dict[str, str] | None,
        shares: dict[str, float] | None,
        draw: tuple[int, int | None],
    ) -> SplitRule:
        given = {"folders": folders, "lists": lists, "shares": shares}
        keys = [f"dataset.{key}" for key, value in given.items() if value is not None]
        in_path = SPLIT in self.patterns.rgb.words
        if len(keys) > 1 or (in_path and keys not in ([], ["dataset.folders"])):
            braces = [f"{{{SPLIT}}} in dataset.rgb"] if in_path else []
            raise InputError(
                f"dataset: {' and '.join([*keys, *braces])} both define the splits; keep one "
                f"(a folder with another meaning needs another word, such as {{part}})."
            )
        if shares is None and draw != (0, None):
            raise InputError(
                "dataset.shares_seed and dataset.block are for dataset.shares, which is null; give "
                "shares, or omit both."
            )
        if shares is not None:
            return ByShare(self.frames, shares, *draw)
        if lists is not None:
            return ByList(self.frames, self.root, lists)
        if not in_path:
            raise InputError(
                f"dataset: nothing defines the splits; write {{{SPLIT}}} in dataset.rgb instead of "
                "train, val and test, or give dataset.lists or dataset.shares."
            )
        return ByFolder(self.frames, self.patterns.rgb, FOLDERS if folders is None else folders)

    def _check_split(self, split: str) -> None:
        if split not in self.splits:
            raise InputError(
                f"dataset has no split '{split}' (folders, lists or shares); "
                f"{nearest(split, self.splits)}."
            )

    def _check_night(self) -> None:
        if self.night is not None and not any(self.nights(tuple(self.frames)) or ()):
            raise InputError(
                f"dataset.night: none of {len(self.frames)} names matches '{self.night}', the "
                f"first is '{next(iter(self.frames))}'; correct it, or set it to null."
            )


def _palette(
    num_classes: int,
    classes: tuple[str, ...],
    palette: tuple[Colour, ...] | None,
    colours: dict[str, Colour | tuple[Colour, ...]] | None,
) -> tuple[Colour, ...]:
    if palette is not None:
        return palette
    generated = painted(num_classes)
    if colours is None:
        return generated
    return tuple(
        each_colour(colours[word])[0] if word in colours else colour
        for word, colour in zip(classes, generated, strict=False)
    )
