"""The base class of data sets that read each image and label from a separate file."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.files import is_there, within
from rgbt.data.images import PairPattern, PairReader, Range, check_size
from rgbt.data.labels import LabelCodes
from rgbt.data.patterns import Frame, Patterns
from rgbt.data.splits import SplitRule
from rgbt.requirements import Record
from rgbt.types import Sample

SplitNames = Mapping[str, tuple[str, ...]]
"""Split -> names, of the splits whose names could be read."""


class FileDataset:
    """A reader of files that never resizes, augments or remaps and refuses inexact content.

    Subclasses define the attributes below, `frame` and `nights`, and the members for `rgbt check`
    if they differ.

    Args:
        root: its folder.
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
        InputError: no such folder; numbers of classes, names and colours that differ; or a class
            that is not one.
    """

    images: PairReader
    codes: LabelCodes
    patterns: Patterns
    rule: SplitRule

    splits_key = "dataset.splits"
    """Setting that names the splits, for messages."""

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

    def follow(self, rgb: str, thermal: str, label: str | None, limits: Range | None) -> None:
        """Read images by the patterns of a user's configuration; InputError for invalid ones."""
        if limits is not None and not limits[0] < limits[1]:
            raise InputError(
                f"dataset.thermal_range: expected [low, high], got {list(limits)}: the thermal "
                "values that become black and white."
            )
        self.patterns = Patterns.of(rgb, thermal, label)
        self.images = PairReader(
            layouts=(PairPattern(rgb, thermal),),
            thermal_range=limits,
            advice="dataset.thermal with the pattern of dataset.rgb reads a fourth channel as "
            "thermal; values that are no grey levels of 8 bits require dataset.thermal_range="
            "[low, high], the values that become black and white",
        )

    def listed(self, split: str) -> tuple[str, ...]:
        """Names of a known split, in order; () if there are none, InputError if unreadable."""
        return self.rule.names(split)

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        if split not in self._names:
            self._names[split] = self.listed(split)
        return bool(self._names[split])

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order; InputError if it is unknown, missing or empty."""
        if not self.has(split):
            raise InputError(
                f"split '{split}' of {self.name} is empty: expected "
                f"{self.splits.get(split, 'nothing')} in {self.root}."
            )
        return self._names[split]

    def frame(self, name: str) -> Frame:
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

    def existing(self, what: str, path: Path, name: str) -> Path:
        """`path`, one file of the sample `name`; InputError if it is missing or outside `root`."""
        if not is_there(path):
            raise InputError(
                f"'{name}': its {what} {path} is missing; restore it, or skip unreadable frames "
                "with data.on_error=skip."
            )
        return within(path, self.root)

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
        rgb = self.existing("RGB image", frame.rgb, name)
        return self.images.read(name, rgb, self.existing("thermal image", frame.thermal, name))

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W) uint8, or None; InputError as there."""
        path = self.frame(name).label
        return None if path is None else self.codes.read(self.existing("label", path, name))

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        keys = ("layouts", "thermal_range", "most_tint", "crop")
        settings = {key: getattr(self.images, key) for key in keys}
        return {"codes": sorted(self.codes.codes.items()), **settings}

    def fingerprint(self) -> str:
        """See `hash_of_files`; splits that are not there are empty."""
        return hash_of_files({split: self.listed(split) for split in self.splits}, self.files)

    # Members for `rgbt check`.

    @property
    def title(self) -> str:
        """The layout, for a headline."""
        return type(self).__name__

    mirrored: str | None = None
    """Suffix of the names of mirrored copies, which only training splits may list."""

    def repeats(self, split: str) -> bool:
        """Whether a split only repeats images of other splits, and need not exist."""
        return split.endswith(("_day", "_night"))

    def sources(self, split: str) -> tuple[str, ...]:
        """The source of a split; splits of one source may share names."""
        return (self.splits[split],)

    def unused(self, lists: SplitNames) -> Iterable[Path]:
        """Files of the layout that belong to no image of a split."""
        used = {path for names in lists.values() for name in names for path in self.files(name)}
        patterns = (pattern for pattern in self.patterns if pattern is not None)
        return {match.path for each in patterns for match in each.files(self.root)} - used

    def own_problems(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Further problems of names and files; no image is opened."""
        return []

    def own_notes(self, lists: SplitNames) -> list[str]:  # noqa: ARG002 - of subclasses
        """Further remarks."""
        return []


def hash_of_files(
    splits: Mapping[str, tuple[str, ...]], files: Callable[[str], Iterable[Path]]
) -> str:
    """SHA-256 in hexadecimal over the names of every split and the sizes of their files.

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
    """Bytes of a file, -1 if it is missing."""
    # A path through a file instead of a folder is missing as well.
    try:
        return path.stat().st_size
    except (FileNotFoundError, NotADirectoryError):
        return -1
