"""Find the files of each frame of the Freiburg Thermal archives, without opening them."""

from __future__ import annotations

from pathlib import Path

from rgbt.checks import InputError
from rgbt.data.folder.frames import FolderFrame
from rgbt.data.folder.pattern import Pattern, WordValues
from rgbt.data.images import PairPattern

RGB, THERMAL, LABEL = "fl_rgb", "fl_ir_aligned", "fl_rgb_labels"
"""Folders of a training sequence, and prefixes of the names of their files."""

TEST_RGB, TEST_THERMAL, TEST_LABEL = "ImagesRGB", "ImagesIR", "SegmentationClass"
"""Folders of the test part; their case differs between copies and is ignored."""

TRAIN = PairPattern(
    *(f"train/{{sequence}}/{{piece}}/{kind}/{kind}_{{stamp}}.png" for kind in (RGB, THERMAL, LABEL))
)
TEST = PairPattern(
    f"{{part}}/{{time}}/{TEST_RGB}/{{stamp}}_rgb.png",
    f"{{part}}/{{time}}/{TEST_THERMAL}/{{stamp}}_ir.png",
    f"{{part}}/{{time}}/{TEST_LABEL}/{{stamp}}_rgb.npy",
)
KEY = "dataset.root"


def find_frames(root: Path) -> tuple[dict[str, FolderFrame], list[Path]]:
    """Name -> frame: training sequences, test by day, test by night; and files of no frame.

    Names are "seq_00_day_00_<seconds>_<nanoseconds>" and "test_night_<...>_<...>"; among the values
    of a frame is its "time". In a folder frames are sorted by file name. Training frames at night
    have no label.

    Raises:
        InputError: a folder without a time of day, two frames of one name, or two RGB images with
            one thermal image.
    """
    for folder, values in Pattern("train/{sequence}", KEY).files(root, any_case=True):
        times = [time for time in ("day", "night") if time in values["sequence"].lower()]
        if folder.is_dir() and len(times) != 1:
            raise InputError(
                f"{folder}: expected the name of a sequence with day or night, such as "
                "seq_00_day; rename the folder, or move it out of the training part."
            )
    frames: dict[str, FolderFrame] = {}
    others: list[Path] = []
    for layout, known in (
        (TRAIN, {}),
        *((TEST, {"part": "test", "time": time}) for time in ("day", "night")),
    ):
        found, unused = _find_in(root, layout, known)
        for frame in found:
            if frame.name in frames:
                raise InputError(
                    f"{frame.rgb}: there is another frame called '{frame.name}'; remove one."
                )
            frames[frame.name] = frame
        others += unused
    return frames, others


def _find_in(
    root: Path, layout: PairPattern, known: WordValues
) -> tuple[list[FolderFrame], list[Path]]:
    """The frames of one part, and thermal images and labels of no frame."""
    assert layout.label is not None, "both parts have labels"
    thermals, labels = (
        {tuple(values.values()): path for path, values in each.files(root, known, any_case=True)}
        for each in (Pattern(layout.thermal, KEY), Pattern(layout.label, KEY))
    )
    frames = []
    rgb_of: dict[Path, Path] = {}
    for rgb, values in Pattern(layout.rgb, KEY).files(root, known, any_case=True):
        words = tuple(values.values())
        # Stamps of RGB and label end in the number of the frame in its burst, always 0. Stamps of
        # thermal images do so in one part of the archive only.
        without = (*words[:-1], words[-1].removesuffix("0")) if known else words
        thermal = thermals.get(words) or thermals.get(without)
        thermal = thermal or Pattern(layout.thermal, KEY).path(root, values)
        if thermal in rgb_of:
            raise InputError(
                f"{rgb} and {rgb_of[thermal]} would both have {thermal} as their thermal image; "
                "remove or rename the wrong one."
            )
        rgb_of[thermal] = rgb
        at_night = "night" in values.get("sequence", known.get("time", "")).lower()
        label = labels.get(words) or Pattern(layout.label, KEY).path(root, values)
        frames.append(
            FolderFrame(
                name="_".join(words),
                values={**values, "time": "night" if at_night else "day"},
                rgb=rgb,
                thermal=thermal,
                label=None if at_night and not known else label,
            )
        )
    used = {path for frame in frames for path in (frame.thermal, frame.label)}
    return frames, [path for path in (*thermals.values(), *labels.values()) if path not in used]


def inside(parent: Path, word: str) -> Path:
    """The folder `word` of `parent`, ignoring case; `parent / word` if there is none."""
    alike = [path for path in parent.iterdir() if path.is_dir() and path.name.lower() == word]
    return alike[0] if alike else parent / word
