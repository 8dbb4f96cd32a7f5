"""The base class of data sets that read each image and label from a separate file."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.folder.frames import FolderFrame, Patterns, patterns_of
from rgbt.data.folder.splits import SplitRule
from rgbt.data.images import PairPattern, PairReader, Range, check_limits, reader_of_patterns
from rgbt.data.labels import LabelCodes
from rgbt.data.named_files import check_size, existing_file, hash_of_files
from rgbt.requirements import Record
from rgbt.types import Sample

SplitNames = Mapping[str, tuple[str, ...]]
"""Split -> names, of the splits whose names could be read."""


class Expected(NamedTuple):
    """Numbers of the published data set, with which `rgbt check` compares a copy.

    Attributes:
        name: of the data set; those with another name are not compared.
        day_night: split -> its images by day and at night, without mirrored copies.
        images: split -> its images.
        hw: size of the images.
    """

    name: str
    day_night: Mapping[str, tuple[int, int]] = {}
    images: Mapping[str, int] = {}
    hw: tuple[int, int] | None = None


class FileDataset:
    """A reader of files that never resizes, augments or remaps and refuses inexact content.

    Subclasses define the attributes below, `frame` and `nights`, and the members for `rgbt check`
    if they differ.

    Args:
        root: its folder, which exists.
        name: used in messages and tables.
        num_classes: number of classes; other nodes of the configuration interpolate it.
        classes: their names, in order of the class index.
        palette: their (red, green, blue) colours, 0..255.
        unscored: classes that are counted but left out of every mean over classes; (): every class
            counts, as in the published tables.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.

    Attributes:
        images: how its images, and new ones of any folder, are read.
        codes: the meaning of label values.
        patterns: of the paths of its files, where they follow patterns.
        rule: divides its frames into splits, where a subclass does not.

    Raises:
        InputError: numbers of classes, names and colours differ, or a class that is not one.
    """

    images: PairReader
    codes: LabelCodes
    patterns: Patterns
    rule: SplitRule

    splits_key = "dataset.splits"
    """Setting that names the splits, for messages."""

    def __init__(  # noqa: PLR0913 - settings of every data set
        self,
        root: Path,
        name: str,
        num_classes: int,
        classes: tuple[str, ...],
        palette: tuple[tuple[int, int, int], ...],
        *,
        background: tuple[str, ...],
        unscored: tuple[str, ...] = (),
    ) -> None:
        for key, length in (("classes", len(classes)), ("palette", len(palette))):
            if length != num_classes:
                raise InputError(
                    f"dataset.num_classes is {num_classes} but dataset.{key} has {length} "
                    "entries; both numbers must be equal."
                )
        self.root = root
        self.name = name
        self.num_classes = num_classes
        self.classes = classes
        self.palette = palette
        self.check_classes(unscored=unscored, background=background)
        self.unscored, self.background = unscored, background
        self._names: dict[str, tuple[str, ...]] = {}

    @property
    def record(self) -> Record:
        """The number of its classes, and what the first one is."""
        is_background = self.classes[0] in self.background
        return Record(
            num_classes=self.num_classes,
            first_class="background" if is_background else "object",
        )

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its list, or the pattern of its files."""
        return self.rule.splits

    def check_classes(self, **settings: tuple[str, ...]) -> None:
        """Refuse settings that name what is not one of its classes (InputError)."""
        for key, chosen in settings.items():
            for word in chosen:
                check_choice(f"dataset.{key}", word, self.classes)

    def follow(self, layout: PairPattern, thermal_range: Range | None) -> None:
        """Read images by the patterns of a user's configuration; InputError for invalid ones."""
        check_limits(thermal_range)
        self.clipping = thermal_range
        self.patterns = patterns_of(*layout)
        self.images = reader_of_patterns(layout, thermal_range)

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        return self.rule.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order; InputError if it is unknown, missing or empty."""
        self.check_split(split)
        if split not in self._names:
            self._names[split] = self.rule.names(split)
        return self._names[split]

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; InputError if there can be no such frame."""
        raise NotImplementedError

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each image was taken at night; None if the data set does not state it."""
        raise NotImplementedError

    def check_split(self, split: str) -> None:
        """Refuse a split that is not one of `splits`."""
        if split not in self.splits:
            raise InputError(
                f"{self.splits_key} has no split '{split}'; {nearest(split, self.splits)}."
            )

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens: RGB, thermal (if it has its own) and label (if any)."""
        frame = self.frame(name)
        paths = (frame.rgb, frame.thermal, frame.label)
        return tuple(dict.fromkeys(path for path in paths if path is not None))

    def read(self, name: str) -> Sample:
        """The sample called `name`, decoded.

        Returns:
            Sample with rgb (H, W, 3), thermal (H, W), label (H, W) or None, all uint8.

        Raises:
            InputError: no such name, a file is missing, leads out of the root, cannot be decoded,
                has other channels, bits or size than expected, or the label holds a value that has
                no meaning.
        """
        pair, label = self.pair(name), self.label(name)
        if label is not None:
            check_size(pair.rgb, "its label", label, name, self.frame(name).label)
        return replace(pair, label=label)

    def pair(self, name: str) -> Sample:
        """The images of `read` alone, without the label; InputError as there."""
        frame = self.frame(name)
        rgb = existing_file("RGB image", frame.rgb, name, self.root)
        return self.images.read(
            name, rgb, existing_file("thermal image", frame.thermal, name, self.root)
        )

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W) uint8, or None; InputError as there."""
        path = self.frame(name).label
        if path is None:
            return None
        return self.codes.read(existing_file("label", path, name, self.root))

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {
            "codes": sorted(self.codes.codes.items()),
            "layouts": [list(layout) for layout in self.images.layouts],
            **{key: getattr(self.images, key) for key in ("thermal_range", "most_tint", "crop")},
        }

    def fingerprint(self) -> str:
        """See `hash_of_files`; splits that are not there are empty."""
        names = {split: self.names(split) if self.has(split) else () for split in self.splits}
        return hash_of_files(names, self.files)

    # Members for `rgbt check`.

    @property
    def title(self) -> str:
        """The layout, for a headline."""
        return type(self).__name__

    expected: Expected | None = None
    """Numbers of the published data set."""

    clipping: Range | None = None
    """Range of thermal values whose shares are reported; None: none is."""

    most_clipped: float = 1.0
    """Largest share of the thermal values of a split that may be outside `clipping`."""

    mirrored: str | None = None
    """Suffix of the names of mirrored copies, which only training splits may list."""

    def repeats(self, split: str) -> bool:
        """Whether a split only repeats images of other splits, and need not exist."""
        return split.endswith(("_day", "_night"))

    def sources(self, split: str) -> tuple[str, ...]:
        """The source of a split; splits of one source may share names."""
        return (self.splits[split],)

    def thermal_values(self, name: str) -> NDArray[Any]:
        """Values of the thermal camera that are read, (H, W); InputError as of `read`."""
        frame = self.frame(name)
        path = existing_file("thermal image", frame.thermal, name, self.root)
        is_packed = frame.rgb == frame.thermal
        values = self.images.whole(name, path, path)[1] if is_packed else self.images.values(path)
        return self.images.cut(values, name)

    def unused(self, lists: SplitNames) -> Iterable[Path]:
        """Files of the layout that belong to no image of a split."""
        used = {path for names in lists.values() for name in names for path in self.files(name)}
        return {
            match.path
            for pattern in self.patterns
            if pattern is not None
            for match in pattern.files(self.root)
        } - used

    def own_problems(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Further problems of names and files; no image is opened."""
        return []

    def own_notes(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Further remarks."""
        return []
