"""Read a user's own RGB-thermal data, described by one YAML file.

The file gives paths, splits and label values. The reader never resizes or aligns images, and it
refuses files that it cannot read exactly. docs/tutorials/own-data-set.md has an example.
"""

from __future__ import annotations

import hashlib
import json
from collections import Counter, defaultdict
from collections.abc import Collection, Mapping
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path, PurePath
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError, check_choice
from rgbt.data.file_dataset import FileDataset, Lists, SplitNames, hash_of_files
from rgbt.data.labels import LabelValue, each_colour, label_codes, painted
from rgbt.data.patterns import NAME, SEQUENCE, SPLIT, FrameFiles, find_frames, in_order, without_rgb
from rgbt.data.thermal import ThermalRange
from rgbt.randomness import numpy_generator
from rgbt.ranges import Colour, Names, NumClasses, Seed, Share, Text


class Folder(FileDataset):
    """Reads RGB-thermal pairs in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.patterns`): {name} is the
    frame, {split} its split, {sequence} a group of consecutive frames, and any other word matches
    any text. The values of the words in the path of the RGB image, joined by "_", are the name of a
    sample; thermal image and label have the same values in their paths.
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
        lists: dict[Text, Text | Names] | None = None,
        shares: dict[Text, Share] | None = None,
        shares_seed: Seed = 0,
        block: Annotated[int, Interval(ge=1, le=10**6)] | None = None,
        unlabelled: Names = (),
        ids: dict[LabelValue, Text] | None = None,
        colours: dict[Text, Colour | tuple[Colour, ...]] | None = None,
        ignored: tuple[LabelValue | Colour, ...] = (),
        thermal_range: ThermalRange | None = None,
        night: Text | None = None,
    ) -> None:
        if palette is None:
            own = {word: each_colour(colour)[0] for word, colour in (colours or {}).items()}
            generated = zip(classes, painted(num_classes), strict=False)
            palette = tuple(own.get(word, colour) for word, colour in generated)
        common = (root, name, num_classes, classes, palette)
        super().__init__(*common, background=background, unscored=unscored)
        if len(set(classes)) < num_classes:
            raise InputError(f"dataset.classes: a name occurs twice in {', '.join(classes)}.")
        self.night, self.unlabelled = night, unlabelled
        self.codes = label_codes(classes, ids, colours, ignored)
        self.follow(rgb, thermal, label, thermal_range)
        self.frames = find_frames(self.root, self.patterns)
        self._divided: SplitNames = self._divide(folders, lists, shares, (shares_seed, block))
        for split in unlabelled:
            check_choice("dataset.unlabelled", split, self.splits)
        is_new = set(self.splits) <= set(unlabelled)  # perhaps of the day alone
        if night is not None and not is_new and not any(self.nights(tuple(self.frames)) or ()):
            raise InputError(f"dataset.night: '{night}' matches no name of {len(self.frames)}.")

    def listed(self, split: str) -> tuple[str, ...]:
        """Return the names of a known split: drawn, in a folder, or named by a list."""
        if split in self._divided:
            return self._divided[split]
        lines = self.lines(split)
        names = tuple(map(self._named, lines))
        if lines and set(names).isdisjoint(self.frames):
            raise InputError(
                f"dataset.lists.{split}: none of the {len(lines)} lines of {self.splits[split]} is "
                f"a frame. The first is '{lines[0]}'; expected names such as "
                f"'{next(iter(self.frames))}'."
            )
        return names

    def _named(self, line: str) -> str:
        """Return the frame of a line; of "image,label", as in CART's, the label must be its own."""
        image, comma, label = line.partition(",")
        if not comma or line in self._forms:
            return self._forms.get(line) or self._forms.get(_stem(line), line)
        name = self._forms.get(image) or self._forms.get(_stem(image), image)
        own = self.frames[name].label if name in self.frames else None
        if own is not None and own != self.root / label:
            raise InputError(f"{self.splits_key}: '{line}': the label of '{name}' is {own}.")
        return name

    def _divide(
        self,
        folders: dict[str, str] | None,
        lists: Lists | None,
        shares: dict[str, float] | None,
        draw: tuple[int, int | None],
    ) -> SplitNames:
        """Set `splits`, and return the names of each; of lists, which are read later, nothing."""
        pattern = self.patterns.rgb
        given = {
            f"{{{SPLIT}}} in dataset.rgb": SPLIT in pattern.words or folders is not None,
            "dataset.lists": lists is not None,
            "dataset.shares": shares is not None,
        }
        found_keys = [key for key, is_given in given.items() if is_given]
        if len(found_keys) != 1 or (folders is not None and SPLIT not in pattern.words):
            raise InputError(
                f"dataset: exactly one of {', '.join(given)} must define the splits, got "
                f"{' and '.join(found_keys) or 'none'}."
            )
        if lists is not None:
            self.splits_key = "dataset.lists"
            self.use_lists(lists)
            return {}
        if shares is not None:
            self.splits = {split: f"{share:g} of the frames" for split, share in shares.items()}
            return draw_shares(self.frames, shares, *draw)
        words = {split: split for split in ("train", "val", "test")} if folders is None else folders
        text = pattern.text
        self.splits = {split: text.replace(f"{{{SPLIT}}}", word) for split, word in words.items()}
        found = [(name, frame.values[SPLIT]) for name, frame in self.frames.items()]
        return {s: tuple(name for name, f in found if f == word) for s, word in words.items()}

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`, without a label in splits that have none."""
        if name not in self.frames:
            raise InputError(
                f"{self.name} ({self.root}) has no frame called '{name}': there is no such RGB "
                f"image (dataset.rgb='{self.patterns.rgb.text}')."
            )
        frame = self.frames[name]
        return frame._replace(label=None) if name in self._without_labels else frame

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Say which names match `night`; None if it is not given."""
        if self.night is None:
            return None
        return tuple(fnmatchcase(name, self.night) for name in names)

    def fingerprint(self) -> str:
        """Return SHA-256 in hexadecimal over `hash_of_files` and the map of label values."""
        listed = {
            split: tuple(name for name in self.listed(split) if name in self.frames)
            for split in self.splits
        }
        meaning = json.dumps([sorted(self.codes.codes.items()), self.codes.of_colours])
        files = hash_of_files(listed, self.files)
        return hashlib.sha256(f"{meaning}\n{files}".encode()).hexdigest()

    def unused(self, lists: SplitNames) -> Collection[Path]:  # noqa: ARG002 - as every data set
        """Return thermal images and labels without an RGB image."""
        return without_rgb(self.root, self.patterns[1:], self.frames.values())

    def own_notes(self, lists: SplitNames) -> list[str]:
        """Name the frames of no split."""
        listed = {name for names in lists.values() for name in names}
        others = [name for name in self.frames if name not in listed]
        if not others:
            return []
        return [f"{len(others)} frames are in no split; the first is '{others[0]}'."]

    @cached_property
    def _without_labels(self) -> frozenset[str]:
        return frozenset(name for split in self.unlabelled for name in self.listed(split))

    @cached_property
    def _forms(self) -> dict[str, str]:
        """Return the name of the frame for everything that a line may be; names come first.

        The name; the values of the words of the RGB pattern, joined by "/"; the path of the RGB or
        thermal image below the root, with or without suffix; or the value of {name}, if unique.
        """
        shared = Counter(frame.values[NAME] for frame in self.frames.values())
        forms = {name: name for name in self.frames}
        for name, frame in self.frames.items():
            files = (frame.rgb, frame.thermal)
            paths = [path.relative_to(self.root).as_posix() for path in files]
            for form in ("/".join(frame.values.values()), *paths, *map(_stem, paths)):
                forms.setdefault(form, name)
            if shared[frame.values[NAME]] == 1:
                forms.setdefault(frame.values[NAME], name)
        return forms


def draw_shares(
    frames: Mapping[str, FrameFiles], shares: Mapping[str, float], seed: int, block: int | None
) -> dict[str, tuple[str, ...]]:
    """Divide frames at random into splits: split -> its names, in the order of all frames.

    The unit of the draw is one {sequence}, or the whole folder if the pattern has no such word,
    divided into blocks of `block` consecutive frames, if given. In the order drawn, each unit is
    added to the split that lacks most frames of its share.

    InputError: shares that are not positive or not 1 together, or a split that gets no frame.
    """
    if not all(share > 0 for share in shares.values()) or abs(sum(shares.values()) - 1) > 1e-6:
        raise InputError(
            "dataset.shares: expected shares above 0 that add up to 1, such as {train: 0.8, "
            f"val: 0.1, test: 0.1}}, got {dict(shares)}."
        )
    sequences: dict[str, list[FrameFiles]] = defaultdict(list)
    for frame in frames.values():
        sequences[frame.values.get(SEQUENCE, "")].append(frame)
    units: list[list[str]] = []
    for sequence in sorted(sequences, key=in_order):
        # Two cameras of one moment are consecutive, whatever word is first in the path.
        moments = sorted(
            sequences[sequence], key=lambda f: (in_order(f.values[NAME]), in_order(f.name))
        )
        names = [frame.name for frame in moments]
        size = block or len(names)
        units += [names[start : start + size] for start in range(0, len(names), size)]
    lacking = {split: share * len(frames) for split, share in shares.items()}
    split_of: dict[str, str] = {}
    for index in numpy_generator(seed, "shares").permutation(len(units)):
        split = max(lacking, key=lambda name: lacking[name])
        split_of |= dict.fromkeys(units[index], split)
        lacking[split] -= len(units[index])
    drawn = {split: tuple(n for n in frames if split_of[n] == split) for split in shares}
    for split, names_of_split in drawn.items():
        if not names_of_split:
            raise InputError(
                f"dataset.shares: split '{split}' gets no frame, because neighbours stay together, "
                f"in {len(units)} unit(s) of up to {max(map(len, units))} frames. Set a smaller "
                "dataset.block (frames that stay together), a larger share, or another "
                "dataset.shares_seed."
            )
    return drawn


def _stem(line: str) -> str:
    """Return `line` without what follows the last dot of its last piece."""
    return str(PurePath(line).with_suffix("")) if PurePath(line).name else line
