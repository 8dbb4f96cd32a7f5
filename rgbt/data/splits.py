"""Divide frames into splits by path, by list or by random shares."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path, PurePath
from typing import Protocol

from rgbt.checks import InputError
from rgbt.data.files import is_there, read_names
from rgbt.data.patterns import NAME, SEQUENCE, SPLIT, Frame, Pattern, in_order
from rgbt.randomness import numpy_generator

FOLDERS = {split: split for split in ("train", "val", "test")}
"""Default values of {split}."""

Frames = Mapping[str, Frame]


class SplitRule(Protocol):
    """A rule that divides frames into splits."""

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its definition, for messages."""
        ...

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a known split; () if there are none."""
        ...


@dataclass(frozen=True)
class ByFolder:
    """A split is the value of {split} in the path of the RGB image.

    Attributes:
        frames: all.
        pattern: of the RGB images.
        folders: split -> value of {split}; two splits may share a folder.
    """

    frames: Frames
    pattern: Pattern
    folders: dict[str, str]

    @property
    def splits(self) -> dict[str, str]:
        """Split -> the pattern of its files."""
        text = self.pattern.text
        return {split: text.replace(f"{{{SPLIT}}}", word) for split, word in self.folders.items()}

    def names(self, split: str) -> tuple[str, ...]:
        """Names in its folder."""
        word = self.folders[split]
        return tuple(name for name, frame in self.frames.items() if frame.values[SPLIT] == word)


@dataclass(frozen=True)
class ByList:
    """A split is a file of one line per frame.

    Without `frames`, a line is a name. With them it is the name of one; or the values of the words
    of the RGB pattern, joined by "/"; or the value of {name}, if it is unique; or the path of the
    RGB image below the root. Each may have a suffix.

    Attributes:
        root: of the frames, and of the lists where these are relative.
        lists: split -> file.
        key: of the configuration that names the lists.
        frames: all; empty: every line is a name.
    """

    root: Path
    lists: dict[str, str]
    key: str = "dataset.lists"
    frames: Frames = field(default_factory=dict)

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its list."""
        return dict(self.lists)

    def names(self, split: str) -> tuple[str, ...]:
        """Names in the order of the list; () if there is none.

        A line without a frame is kept, so that reading it raises the error. InputError if no line
        is a frame.
        """
        path, key = self.root / Path(self.lists[split]).expanduser(), f"{self.key}.{split}"
        if not is_there(path):
            return ()
        lines = read_names(path, key)
        if not self.frames:
            return lines
        forms = self._forms()
        names = tuple(forms.get(line) or forms.get(_stem(line)) or line for line in lines)
        if set(names).isdisjoint(self.frames):
            raise InputError(
                f"{key}: none of the {len(lines)} lines of {path} is a frame. The first is "
                f"'{lines[0]}'; expected names such as '{next(iter(self.frames))}'."
            )
        return names

    def _forms(self) -> dict[str, str]:
        """Everything that a line may be -> the name of the frame; names come before all else."""
        shared = Counter(frame.values[NAME] for frame in self.frames.values())
        forms = {name: name for name in self.frames}
        for name, frame in self.frames.items():
            path = frame.rgb.relative_to(self.root).as_posix()
            for form in ("/".join(frame.values.values()), path, _stem(path)):
                forms.setdefault(form, name)
            if shared[frame.values[NAME]] == 1:
                forms.setdefault(frame.values[NAME], name)
        return forms


@dataclass(frozen=True)
class ByShare:
    """Splits are drawn at random with `seed`; consecutive frames are drawn together.

    The unit of the draw is one {sequence}, or the whole folder if the pattern has no such word,
    divided into blocks of `block` frames. In the order drawn, each unit is added to the split that
    lacks most frames of its share.

    Attributes:
        frames: all.
        shares: split -> its share, above 0; together 1.
        seed: of the draw.
        block: frames of a unit; None: sequences stay whole.

    Raises:
        InputError: shares that are not positive or not 1 together, or a split that would get no
            frame.
    """

    frames: Frames
    shares: dict[str, float]
    seed: int
    block: int | None

    def __post_init__(self) -> None:
        shares = self.shares.values()
        if not all(share > 0 for share in shares) or abs(sum(shares) - 1) > 1e-6:
            raise InputError(
                "dataset.shares: expected shares above 0 that add up to 1, such as {train: 0.8, "
                f"val: 0.1, test: 0.1}}, got {self.shares}."
            )
        empty = [split for split in self.shares if not self.drawn[split]]
        if empty:
            raise InputError(
                f"dataset.shares: split '{empty[0]}' gets no frame, because neighbours stay "
                f"together, in {len(self.units)} unit(s) of up to {max(map(len, self.units))} "
                "frames. Set a smaller dataset.block (frames that stay together), a larger share, "
                "or another dataset.shares_seed."
            )

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its share."""
        return {split: f"{share:g} of the frames" for split, share in self.shares.items()}

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split in the order of all frames."""
        drawn = set(self.drawn[split])
        return tuple(name for name in self.frames if name in drawn)

    @cached_property
    def units(self) -> list[list[str]]:
        """Names that stay together."""
        sequences: dict[str, list[Frame]] = defaultdict(list)
        for frame in self.frames.values():
            sequences[frame.values.get(SEQUENCE, "")].append(frame)
        units = []
        for sequence in sorted(sequences, key=in_order):
            # Two cameras of one moment are consecutive, whatever word is first in the path.
            moments = sorted(
                sequences[sequence], key=lambda f: (in_order(f.values[NAME]), in_order(f.name))
            )
            names = [frame.name for frame in moments]
            size = self.block or len(names)
            units += [names[start : start + size] for start in range(0, len(names), size)]
        return units

    @cached_property
    def drawn(self) -> dict[str, list[str]]:
        """Split -> its names."""
        lacking = {split: share * len(self.frames) for split, share in self.shares.items()}
        found: dict[str, list[str]] = {split: [] for split in self.shares}
        for index in numpy_generator(self.seed, "shares").permutation(len(self.units)):
            split = max(lacking, key=lambda each: lacking[each])
            found[split] += self.units[index]
            lacking[split] -= len(self.units[index])
        return found


def _stem(line: str) -> str:
    """`line` without what follows the last dot of its last piece."""
    return str(PurePath(line).with_suffix("")) if PurePath(line).name else line
