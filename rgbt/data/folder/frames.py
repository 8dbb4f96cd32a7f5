"""Find the files of each frame of a folder by patterns of paths, without opening them."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from rgbt.checks import InputError, nearest
from rgbt.data.folder.pattern import NAME, PathMatch, Pattern, WordValues, in_order, what_is_in


class FolderFrame(NamedTuple):
    """One pair of images and its label.

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
    """Patterns of the three images of a frame; `label` is None for a data set without labels."""

    rgb: Pattern
    thermal: Pattern
    label: Pattern | None

    @classmethod
    def of(cls, rgb: str, thermal: str, label: str | None) -> Patterns:
        """Those of the texts of a configuration; InputError for an invalid pattern."""
        return cls(
            Pattern(rgb, "dataset.rgb"),
            Pattern(thermal, "dataset.thermal"),
            None if label is None else Pattern(label, "dataset.label"),
        )

    def frame(self, root: Path, name: str, values: WordValues) -> FolderFrame:
        """The files of a frame, whether they exist or not; `values` has every word."""
        label = None if self.label is None else self.label.path(root, values)
        rgb, thermal = (pattern.path(root, values) for pattern in (self.rgb, self.thermal))
        return FolderFrame(name, values, rgb, thermal, label)


def patterns_of(rgb: str, thermal: str, label: str | None) -> Patterns:
    """The patterns of a user's configuration.

    Raises:
        InputError: an invalid pattern, no {name} in the first, words that only the others have,
            or labels in a format that changes values.
    """
    found = Patterns.of(rgb, thermal, label)
    if NAME not in found.rgb.words:
        raise InputError(
            f"dataset.rgb: '{rgb}' has the word {', '.join(found.rgb.words)} but no {NAME}; "
            f"replace the names of frames with {{{NAME}}}."
        )
    for pattern in [each for each in found if each is not None]:
        for word in pattern.words:
            if word not in found.rgb.words:
                raise InputError(
                    f"{pattern.key}: '{pattern.text}' uses {{{word}}}, which dataset.rgb='{rgb}' "
                    f"does not contain; {nearest(word, found.rgb.words)}."
                )
    if label is not None and label.lower().endswith((".jpg", ".jpeg")):
        raise InputError(
            f"dataset.label: '{label}' are JPEG files, which change values and colours; save "
            "labels as PNG."
        )
    return found


def find_frames(root: Path, patterns: Patterns) -> dict[str, FolderFrame]:
    """Name -> frame, of every RGB image below `root`, in the order of the names (9 before 10).

    Raises:
        InputError: no RGB image, no thermal image, two frames of one name, or two that would
            share a partner.
    """
    rgb, thermal, label = patterns
    every = [
        patterns.frame(root, "_".join(values[word] for word in rgb.words), values)
        for _, values in rgb.files(root)
    ]
    # If all are in one folder, "{name}.png" matches 7.png and 7_ir.png, which is "{name}_ir.png".
    partners = {path for each in every for path in (each.thermal, each.label) if path != each.rgb}
    frames: dict[str, FolderFrame] = {}
    for frame in every:
        if frame.rgb in partners:
            continue
        if frame.name in frames:
            raise InputError(
                f"dataset.rgb: {frames[frame.name].rgb} and {frame.rgb} would both be called "
                f"'{frame.name}'; rename one of them."
            )
        frames[frame.name] = frame
    if not frames:
        raise InputError(
            f"dataset.rgb: '{rgb.text}' matches no file in {root}: {rgb.why_nothing(root)}; "
            "correct the pattern or dataset.root."
        )
    found = {name: frames[name] for name in sorted(frames, key=in_order)}
    for pattern in (thermal, label):
        if pattern is not None:
            _check_shared(pattern, found, root)
    check_partners(thermal, found.values(), root)
    return found


def check_partners(pattern: Pattern, frames: Iterable[FolderFrame], root: Path) -> None:
    """Refuse a pattern by which no frame of `frames`, if there are any, has an existing file."""
    paths = [pattern.path(root, frame.values) for frame in frames]
    if paths and not any(map(os.path.lexists, paths)):
        raise InputError(
            f"{pattern.key}: '{pattern.text}' matches no existing file: the first would be "
            f"{paths[0]}, but {paths[0].parent.name} holds {what_is_in(paths[0].parent)}; correct "
            "the pattern."
        )


def without_rgb(
    root: Path, partners: Iterable[Pattern | None], frames: Iterable[FolderFrame]
) -> list[PathMatch]:
    """Files of the patterns of thermal images and labels that belong to no frame."""
    used = {path for each in frames for path in (each.rgb, each.thermal, each.label)}
    matches = [match for each in partners if each is not None for match in each.files(root)]
    return [match for match in matches if match.path not in used]


def _check_shared(pattern: Pattern, frames: dict[str, FolderFrame], root: Path) -> None:
    partners: dict[Path, str] = {}
    for name, frame in frames.items():
        path = pattern.path(root, frame.values)
        if path in partners:
            raise InputError(
                f"{pattern.key}: '{partners[path]}' and '{name}' would share {path}; use every "
                "word of dataset.rgb in which they differ."
            )
        partners[path] = name
