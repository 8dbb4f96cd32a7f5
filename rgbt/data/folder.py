"""Read a user's own RGB-thermal data, described by one YAML file.

The file gives paths, splits and label values. The reader never resizes or aligns images, and it
refuses files that it cannot read exactly. docs/tutorials/own-data-set.md has an example.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError, check_choice
from rgbt.data.file_dataset import FileDataset, SplitNames, hash_of_files
from rgbt.data.images import Range
from rgbt.data.labels import LabelValue, each_colour, label_codes, painted
from rgbt.data.patterns import SPLIT, Frame, check_partners, find_frames, without_rgb
from rgbt.data.splits import FOLDERS, ByFolder, ByList, ByShare, SplitRule
from rgbt.ranges import Colour, Names, NumClasses, Seed, Share, Text


class Folder(FileDataset):
    """RGB-thermal pairs in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.patterns`): {name} is the
    frame, {split} its split, {sequence} a group of consecutive frames, and any other word matches
    any text. The values of the words in the path of the RGB image, joined by "_", are the name of a
    sample; thermal image and label have the same values in their paths.

    Arguments: the keys of conf/dataset/folder.yaml, which describes each. InputError: no such
    root, another layout, or settings that do not fit each other.
    """

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
        background: Names = (),
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
        if palette is None:
            own = {word: each_colour(colour)[0] for word, colour in (colours or {}).items()}
            generated = zip(classes, painted(num_classes), strict=False)
            palette = tuple(own.get(word, colour) for word, colour in generated)
        super().__init__(
            *(root, name, num_classes, classes, palette),
            background=background,
            unscored=unscored,
        )
        if len(set(classes)) < num_classes:
            raise InputError(f"dataset.classes: a name occurs twice in {', '.join(classes)}.")
        self.night = night
        self.codes = label_codes(classes, ids, colours, ignored)
        self.follow(rgb, thermal, label, thermal_range)
        self.frames = find_frames(self.root, self.patterns)
        self.rule = self._rule_of(folders, lists, shares, (shares_seed, block))
        self.unlabelled = unlabelled
        for split in unlabelled:
            check_choice("dataset.unlabelled", split, self.splits)
        # Without labelled splits these may be new images, of the day alone and without labels.
        if set(self.splits) - set(unlabelled):
            self._check_labels_and_night()

    def frame(self, name: str) -> Frame:
        """The files of `name`, without a label in splits that have none."""
        if name not in self.frames:
            raise InputError(
                f"{self.name} ({self.root}) has no frame called '{name}': there is no such RGB "
                f"image (dataset.rgb='{self.patterns.rgb.text}')."
            )
        frame = self.frames[name]
        return frame._replace(label=None) if name in self._without_labels else frame

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each name matches `night`; None if it is not given."""
        if self.night is None:
            return None
        return tuple(fnmatchcase(name, self.night) for name in names)

    def fingerprint(self) -> str:
        """SHA-256 in hexadecimal over `hash_of_files` and the map of label values."""
        listed = {
            split: tuple(name for name in self.listed(split) if name in self.frames)
            for split in self.splits
        }
        meaning = json.dumps([sorted(self.codes.codes.items()), self.codes.of_colours])
        files = hash_of_files(listed, self.files)
        return hashlib.sha256(f"{meaning}\n{files}".encode()).hexdigest()

    @property
    def title(self) -> str:
        """The patterns of its images."""
        return str(self.images.layouts[0])

    def unused(self, lists: SplitNames) -> Iterable[Path]:  # noqa: ARG002 - as every data set
        """Thermal images and labels without an RGB image."""
        matches = without_rgb(self.root, self.patterns[1:], self.frames.values())
        return {match.path for match in matches}

    def own_notes(self, lists: SplitNames) -> list[str]:
        """Frames of no split."""
        others = [name for name in self.frames if name not in set().union(*lists.values())]
        first = others[:1]
        return [f"{len(others)} frames are in no split; the first is '{name}'." for name in first]

    @cached_property
    def _without_labels(self) -> frozenset[str]:
        return frozenset(name for split in self.unlabelled for name in self.listed(split))

    def _rule_of(
        self,
        folders: dict[str, str] | None,
        lists: dict[str, str] | None,
        shares: dict[str, float] | None,
        draw: tuple[int, int | None],
    ) -> SplitRule:
        in_path = SPLIT in self.patterns.rgb.words
        given = {
            f"{{{SPLIT}}} in dataset.rgb": in_path or folders is not None,
            "dataset.lists": lists is not None,
            "dataset.shares": shares is not None,
        }
        if sum(given.values()) != 1 or (folders is not None and not in_path):
            raise InputError(
                f"dataset: exactly one of {', '.join(given)} must define the splits, got "
                f"{' and '.join(key for key, each in given.items() if each) or 'none'}."
            )
        if shares is None and draw != (0, None):
            raise InputError("dataset.shares_seed and dataset.block require dataset.shares.")
        if shares is not None:
            return ByShare(self.frames, shares, *draw)
        if lists is not None:
            return ByList(self.root, lists, frames=self.frames)
        return ByFolder(self.frames, self.patterns.rgb, FOLDERS if folders is None else folders)

    def _check_labels_and_night(self) -> None:
        labelled = [f for name, f in self.frames.items() if name not in self._without_labels]
        if self.patterns.label is not None:
            check_partners(self.patterns.label, labelled, self.root)
        if self.night is not None and not any(self.nights(tuple(self.frames)) or ()):
            raise InputError(
                f"dataset.night: none of {len(self.frames)} names matches '{self.night}'; the "
                f"first name is '{next(iter(self.frames))}'."
            )
