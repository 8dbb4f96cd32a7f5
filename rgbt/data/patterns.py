"""Patterns of paths such as "{split}/rgb/{name}.png", and the frames whose files match them."""

from __future__ import annotations

import glob
import os
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from rgbt.checks import InputError, check_choice

# Words with a meaning: the frame, its split, a group of consecutive frames.
NAME, SPLIT, SEQUENCE = "name", "split", "sequence"

# Word -> its value in the path of a file.
WordValues = Mapping[str, str]


@dataclass(frozen=True)
class Pattern:
    """Matches paths below a root; a word in braces matches any text without a slash.

    A word that occurs twice has the same value in both positions. Of two words in one piece of the
    path the first matches as much as possible: "{sequence}_{name}.png" reads a_b_c.png as a_b, c.

    Attributes:
        text: pieces joined by "/", relative to the root; such as "{split}/ir/{name}_ir.tif".
        key: of the configuration, for messages.

    Raises:
        InputError: an absolute path, "..", an unpaired brace, two words with nothing between them,
            or no word.
    """

    text: str
    key: str

    def __post_init__(self) -> None:
        is_below = set(self.text.split("/")).isdisjoint(("", ".", ".."))
        plain = re.sub(r"\{[^\W\d]\w*\}", "", self.text)
        if not is_below or re.search(r"[{}]", plain) or "}{" in self.text or not self.words:
            raise InputError(
                f"{self.key}: expected a path below dataset.root with words in braces and other "
                f"text between them, such as {{split}}/rgb/{{name}}.png, got '{self.text}'."
            )

    @cached_property
    def words(self) -> tuple[str, ...]:
        """Return the words in braces, in order."""
        return tuple(dict.fromkeys(re.findall(r"\{(\w+)\}", self.text)))

    def path(self, root: Path, values: WordValues) -> Path:
        """Return the file of `values`, which has every word."""
        return root / _filled(self.text, values)

    def files(
        self, root: Path, values: WordValues = MappingProxyType({}), *, any_case: bool = False
    ) -> dict[Path, WordValues]:
        """Return the paths below `root` that match, sorted, and the values of the words in each.

        Words with a value match this one alone. Names that begin with a dot are left out, as
        operating systems write such files. InputError if a folder may not be listed.
        """
        text = _filled(self.text, values)
        wild = re.sub(r"\{\w+\}", "*", glob.escape(text))
        if any_case:
            wild = re.sub(r"[^\W\d_]", _in_any_case, wild)
        # `glob` leaves out folders without permission; that of `Path` lists hidden files as well,
        # and no broken links.
        above = wild.rpartition("/")[0]
        while above:
            for folder in glob.glob(above, root_dir=root):  # noqa: PTH207
                _check_listable(root / folder)
            above = above.rpartition("/")[0]
        _check_listable(root)
        expression = re.compile(_expression(text), re.IGNORECASE * any_case)
        found: dict[Path, WordValues] = {}
        for path in sorted(glob.glob(wild, root_dir=root), key=lambda path: path.split("/")):  # noqa: PTH207
            match = expression.fullmatch(path)
            if match:
                found[root / path] = {**values, **match.groupdict()}
        return found


def _in_any_case(letter: re.Match[str]) -> str:
    """Return a wildcard for both cases of a letter: "[aA]"."""
    return f"[{letter[0].lower()}{letter[0].upper()}]"


def _filled(text: str, values: WordValues) -> str:
    """Replace the words of `text` whose values are known."""
    return re.sub(r"\{(\w+)\}", lambda word: values.get(word[1], word[0]), text)


def _expression(text: str) -> str:
    """Write the regular expression of a pattern; a repeated word refers to the first one."""
    parts = re.split(r"\{(\w+)\}", text)
    for index, part in enumerate(parts):
        if index % 2 == 0:
            parts[index] = re.escape(part)
        else:
            first = f"(?P<{part}>[^/]+)"
            parts[index] = f"(?P={part})" if first in parts else first
    return "".join(parts)


def _check_listable(folder: Path) -> None:
    if folder.is_dir() and not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"{folder} cannot be listed: permission denied; allow access.")


def what_is_in(folder: Path) -> str:
    """Return the first few names in `folder`, for a message."""
    names = sorted(path.name for path in folder.glob("[!.]*"))
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return ", ".join(names[:4]) + more if names else "nothing"


def in_order(text: str) -> list[tuple[bool, int, str]]:
    """Return a key to sort names by, numbers by their value: frame_9 comes before frame_10."""
    pieces = re.split(r"([0-9]+)", text)
    return [
        (index % 2 == 0, int(piece) if index % 2 else 0, piece)
        for index, piece in enumerate(pieces)
    ]


class FrameFiles(NamedTuple):
    """Names the files of one pair of images and its label.

    Attributes:
        name: values of the words of the RGB pattern, joined by "_".
        values: value of each word.
        rgb: existing file.
        thermal: expected file; the same one if thermal is its fourth channel.
        label: expected file; None if the data set has no labels.
    """

    name: str
    values: WordValues
    rgb: Path
    thermal: Path
    label: Path | None


class Patterns(NamedTuple):
    """Holds the patterns of the images of a frame; `label` is None where there are no labels."""

    rgb: Pattern
    thermal: Pattern
    label: Pattern | None

    @classmethod
    def of(cls, rgb: str, thermal: str, label: str | None = None) -> Patterns:
        """Make the patterns of a configuration's texts; InputError for an invalid one."""
        of_label = None if label is None else Pattern(label, "dataset.label")
        return cls(Pattern(rgb, "dataset.rgb"), Pattern(thermal, "dataset.thermal"), of_label)

    @property
    def packed(self) -> bool:
        """Say whether thermal is the fourth channel of the RGB image."""
        return self.rgb.text == self.thermal.text

    def __str__(self) -> str:
        rgb, thermal = self.rgb.text, self.thermal.text
        return f"{rgb} of four channels" if self.packed else f"RGB {rgb} with thermal {thermal}"

    def frame(self, root: Path, name: str, values: WordValues) -> FrameFiles:
        """Return the files of a frame, whether they exist or not; `values` has every word."""
        label = None if self.label is None else self.label.path(root, values)
        rgb, thermal = (pattern.path(root, values) for pattern in (self.rgb, self.thermal))
        return FrameFiles(name, values, rgb, thermal, label)

    def frames(self, root: Path) -> dict[str, FrameFiles]:
        """Find the frame of every RGB image below `root`, by name, in order (9 before 10).

        InputError if two have one name.
        """
        every = [
            self.frame(root, "_".join(values[word] for word in self.rgb.words), values)
            for values in self.rgb.files(root).values()
        ]
        # In a single folder, "{name}.png" matches 7.png and 7_ir.png, which is "{name}_ir.png".
        partners: set[Path | None] = set()
        for frame in every:
            partners.update({frame.thermal, frame.label} - {frame.rgb})
        frames: dict[str, FrameFiles] = {}
        for frame in every:
            if frame.rgb not in partners and frames.setdefault(frame.name, frame) is not frame:
                raise InputError(
                    f"{self.rgb.key}: {frames[frame.name].rgb} and {frame.rgb} would both be "
                    f"called '{frame.name}'; rename one of them."
                )
        return {name: frames[name] for name in sorted(frames, key=in_order)}


def find_frames(root: Path, patterns: Patterns) -> dict[str, FrameFiles]:
    """Find the frames of a user's configuration, see `Patterns.frames`.

    InputError: no {name} in the first pattern, a word that only another one has, no RGB image, no
    thermal image, or two frames that would share a partner.
    """
    rgb, thermal, label = patterns
    if NAME not in rgb.words:
        raise InputError(f"dataset.rgb: '{rgb.text}' has no {{{NAME}}}, which stands for frames.")
    partners = [pattern for pattern in (thermal, label) if pattern is not None]
    for pattern in partners:
        for word in pattern.words:
            check_choice(f"{pattern.key}: word of the pattern", word, rgb.words)
    frames = patterns.frames(root)
    if not frames:
        raise InputError(
            f"dataset.rgb: '{rgb.text}' matches no file in {root}, which holds {what_is_in(root)}."
        )
    for pattern in partners:
        paths = [pattern.path(root, frame.values) for frame in frames.values()]
        if len(set(paths)) < len(paths):
            shared = next(path for path in paths if paths.count(path) > 1)
            raise InputError(
                f"{pattern.key}: several frames would share {shared}; use every word of "
                "dataset.rgb in which they differ."
            )
        if not any(map(os.path.lexists, paths)) and pattern is thermal:
            folder = next(parent for parent in paths[0].parents if parent.is_dir())
            raise InputError(
                f"{pattern.key}: '{pattern.text}' matches no existing file: the first would be "
                f"{paths[0]}, but {folder.name} holds {what_is_in(folder)}."
            )
    return frames


def without_rgb(
    root: Path, partners: Iterable[Pattern | None], frames: Iterable[FrameFiles]
) -> dict[Path, WordValues]:
    """Find files of the patterns of thermal images and labels that belong to no frame."""
    used = {path for frame in frames for path in frame[2:]}
    found: dict[Path, WordValues] = {}
    for pattern in partners:
        if pattern is not None:
            found |= pattern.files(root)
    return {path: values for path, values in found.items() if path not in used}
