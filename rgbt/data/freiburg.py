"""Freiburg Thermal: labelled days and unlabelled nights for training, both labelled for testing.

A reader only: it crops frames, converts thermal counts to grey levels and resizes labels to the
frame, as configured, and refuses files it cannot read exactly.
"""

from __future__ import annotations

import hashlib
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.file_dataset import FileDataset
from rgbt.data.files import read_counts, read_label, read_label_array
from rgbt.data.freiburg_images import FreiburgImages, whole_frame
from rgbt.data.freiburg_layout import FreiburgFrame, find_frames, inside
from rgbt.data.integrity import within
from rgbt.data.named_files import check_split, existing_file, existing_root, size_of
from rgbt.data.prepare.freiburg import PREPARATION
from rgbt.data.report.freiburg import FreiburgChecks
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE, Sample

CLASSES = (
    *("road", "sidewalk", "building", "curb", "fence", "pole", "vegetation", "terrain", "sky"),
    *("person", "car", "bicycle", "background", "ignore"),
)
PALETTE = (
    *((128, 64, 128), (244, 35, 232), (70, 70, 70), (196, 196, 196), (190, 153, 153)),
    *((153, 153, 153), (107, 142, 35), (152, 251, 152), (70, 130, 180), (220, 20, 60)),
    *((0, 0, 142), (119, 11, 32), (138, 43, 226), (0, 0, 0)),
)
SPLITS = {
    "train": "train/seq_*_day/*/fl_rgb/fl_rgb_*.png",
    "train_day": "train/seq_*_day/*/fl_rgb/fl_rgb_*.png",
    "train_night": "train/seq_*_night/*/fl_rgb/fl_rgb_*.png",
    "val": "train/seq_*_day/*/fl_rgb/fl_rgb_*.png of dataset.val_sequences",
    "test": "test/*/ImagesRGB/*_rgb.png",
    "test_day": "test/day/ImagesRGB/*_rgb.png",
    "test_night": "test/night/ImagesRGB/*_rgb.png",
}
CROP = (5, 645, 360, 1640)
THERMAL_RANGE = (21800, 23700)
Count = Annotated[int, Interval(ge=0, lt=2**16)]
CountRange = tuple[Count, Count]
Edge = Annotated[int, Interval(ge=0, le=8192)]
Crop = tuple[Edge, Edge, Edge, Edge]

MOST_STRETCH = 0.02
"""Largest relative difference of the aspect ratios of label and frame, due to rounding."""

Array = NDArray[np.uint8]


class Freiburg(FileDataset):
    """RGB-thermal street scenes of Freiburg, in the layout of their archives.

    Layout (XX and YY are digits; sec and nsec are seconds and nanoseconds):
        train/seq_XX_{day|night}/YY/fl_rgb/fl_rgb_<sec>_<nsec>.png               8 bit, RGB
                                    fl_ir_aligned/fl_ir_aligned_<sec>_<nsec>.png   16 bit, counts
                                    fl_rgb_labels/fl_rgb_labels_<sec>_<nsec>.png   8 bit, by day
        test/{day|night}/ImagesRGB/*_rgb.png   ImagesIR/*_ir.png   SegmentationClass/*.npy

    Splits: "train_day", "train_night", and "train", which equals "train_day" and is used without
    domains; "val", day sequences that are not in "train_day"; "test_day",
    "test_night", and "test", the day followed by the night. Training frames at night have no
    labels. Those by day, and so those of "val", carry predictions of an RGB network that was
    trained on Mapillary Vistas; only the test part is labelled by hand.

    Thermal counts c become grey levels of eight bits, round(255 (min(max(c, low), high) - low) /
    (high - low)), halves upwards; a level is 7.5 counts wide with the thesis' range. The thesis
    (Eq. 7) and HeatNet compute the same in real numbers from 0 to 1; the code of the thesis stores
    it with eight bits as well.

    Source: HeatNet (Vertens et al., IROS 2020); crop and range: J. Sun, "RGB-only day-night
    semantic segmentation using domain adaptation with thermal images" (TU Eindhoven, 2022) and its
    code.

    Args:
        root: folder that holds `train`, `test` or both.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        unscored: classes that are counted but left out of every mean over classes.
        crop: first row, row after the last, first column, column after the last of the part of
            every frame and label that is used; None: whole frames.
        thermal_range: (low, high) counts that become black and white: [21800, 23700] in the thesis,
            [21800, 25000] in the HeatNet release.
        ignored_test: classes that are ignored in "val" and "test" (they become 255):
            "ignore" in HeatNet, none in the code of the thesis. In training they stay classes.
        val_sequences: day sequences ("seq_04_day") or pieces of them ("seq_03_day/00") that form
            "val".

    Raises:
        InputError: no such root, neither part in it, an invalid crop, range or class, or numbers of
            classes, names and colours that differ.
    """

    images: FreiburgImages
    preparation = PREPARATION

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "freiburg",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        unscored: Names = ("background", "ignore"),
        crop: Crop | None = CROP,
        thermal_range: CountRange = THERMAL_RANGE,
        ignored_test: Names = ("ignore",),
        val_sequences: Names = ("seq_04_day",),
    ) -> None:
        folder = existing_root(root, "that holds train and test")
        super().__init__(folder, name, num_classes, classes, palette)
        self.unscored = unscored
        self.crop = crop
        self.thermal_range = thermal_range
        self.ignored_test = ignored_test
        self.val_sequences = val_sequences
        self.splits = SPLITS
        self._split_frames: dict[str, tuple[FreiburgFrame, ...]] = {}
        _check_root(self.root)
        for key, chosen in (("unscored", unscored), ("ignored_test", ignored_test)):
            for word in chosen:
                check_choice(f"dataset.{key}", word, classes)
        _check_numbers(crop, thermal_range)
        self.images = FreiburgImages(crop, thermal_range)

    def has(self, split: str) -> bool:
        """Whether `split` has frames; InputError if the split is unknown."""
        return bool(self._of(split))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, sorted by folder and file, the day before the night.

        Raises:
            InputError: unknown split, no frame of it, a missing sequence of "val".
        """
        frames = self._of(split)
        if split in ("train", "train_day", "val"):
            self._check_sequences()
        if not frames:
            raise InputError(self._why_empty(split))
        return tuple(frame.name for frame in frames)

    def read(self, name: str) -> Sample:
        """See `FileDataset`; cut, thermal as grey levels, without a label in training at night."""
        frame = self.frame(name)
        pixels, counts = whole_frame(name, *self._image_paths(frame))
        # A label is resized to the whole frame, and cropped with it.
        label = None if frame.label is None else self._label(frame, counts.shape)
        sample = self.images.sample(name, pixels, counts)
        if label is None:
            return sample
        return replace(sample, label=np.ascontiguousarray(self.images.cut(label, name)))

    def pair(self, name: str) -> Sample:
        """The images of `read` alone, without the label; InputError as there."""
        return self.images.read(name, *self._image_paths(self.frame(name)))

    def label(self, name: str) -> Array | None:
        """The label of `read` alone; the frame is read as well, for its size."""
        return self.read(name).label

    def counts(self, name: str) -> NDArray[np.uint16]:
        """Counts of the thermal camera, (H, W) uint16, cut as in `read`; InputError as there."""
        return self.images.cut(read_counts(self._image_paths(self.frame(name))[1]), name)

    def files(self, name: str) -> tuple[Path, ...]:
        """Every file that `read` opens for `name`: RGB, thermal and, where it has one, label."""
        frame = self.frame(name)
        paths = (frame.rgb, frame.thermal, frame.label)
        return tuple(path for path in paths if path is not None)

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {
            "crop": self.crop,
            "thermal_range": self.thermal_range,
            "ignored_test": sorted(self.ignored_test),
            "val_sequences": sorted(self.val_sequences),
            "classes": self.classes,
        }

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each frame is in a night folder; InputError if there is no such frame."""
        return tuple(self.frame(name).night for name in names)

    def fingerprint(self) -> str:
        """As `hash_of_files`, with the settings of labels (crop, `ignored_test`)."""
        digest = hashlib.sha256(f"{self.crop} {sorted(self.ignored_test)}\n".encode())
        for split in sorted(self.splits):
            names = [frame.name for frame in self._of(split)]
            digest.update(f"{split} {len(names)} {' '.join(names)}\n".encode())
        for name in self._frames:
            sizes = [size_of(path) for path in self.files(name)]
            digest.update(f"{name} {sizes}\n".encode())
        return digest.hexdigest()

    def checks(self) -> FreiburgChecks:
        """What `rgbt.data.check` checks of this data set."""
        return FreiburgChecks(self)

    def frame(self, name: str) -> FreiburgFrame:
        """The files of `name`; InputError if there is no such frame."""
        if name not in self._frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self._frames[name]

    @cached_property
    def frames(self) -> tuple[FreiburgFrame, ...]:
        """Every frame; listed once, so later changes of the folder have no effect."""
        return find_frames(self.root)

    @cached_property
    def _frames(self) -> dict[str, FreiburgFrame]:
        return {frame.name: frame for frame in self.frames}

    def _of(self, split: str) -> tuple[FreiburgFrame, ...]:
        if split not in self._split_frames:
            self._split_frames[split] = self._select(split)
        return self._split_frames[split]

    def _select(self, split: str) -> tuple[FreiburgFrame, ...]:
        check_split(split, self.splits)
        part, _, time = split.partition("_")
        time = time or ("day" if part in ("train", "val") else "")
        return tuple(
            frame
            for frame in self.frames
            if self._part(frame) == part and time in ("", "night" if frame.night else "day")
        )

    def _part(self, frame: FreiburgFrame) -> str:
        if frame.is_test:
            return "test"
        held_out = not frame.night and not set(frame.sequences).isdisjoint(self.val_sequences)
        return "val" if held_out else "train"

    def _check_sequences(self) -> None:
        by_day = [frame for frame in self.frames if not (frame.is_test or frame.night)]
        known = {word for frame in by_day for word in frame.sequences}
        for word in self.val_sequences:
            if by_day and word not in known:
                raise InputError(
                    f"dataset.val_sequences: there is no day sequence '{word}' in {self.root}; "
                    f"{nearest(word, {sequence for sequence in known if '/' not in sequence})}."
                )

    def _why_empty(self, split: str) -> str:
        hint = f"unpack the archive '{split.partition('_')[0]}' there"
        if split == "val":
            hint = f"it is {list(self.val_sequences)}, name existing day sequences"
        elif split in ("train", "train_day") and self.has("val"):
            hint = "every day sequence is in dataset.val_sequences, remove one of them"
        return (
            f"split '{split}' of {self.name} is empty: expected {self.splits[split]} in "
            f"{self.root}; {hint}."
        )

    def _image_paths(self, frame: FreiburgFrame) -> tuple[Path, Path]:
        thermal = existing_file("thermal image", frame.thermal, frame.name, self.root)
        return within(frame.rgb, self.root), thermal

    def _label(self, frame: FreiburgFrame, hw: tuple[int, ...]) -> Array:
        """The label, resized to the frame with the nearest pixel."""
        assert frame.label is not None, "the frame has a label"
        path = existing_file("label", frame.label, frame.name, self.root)
        read = read_label if path.suffix == ".png" else read_label_array
        label = read(path, self.num_classes)
        if label.shape != hw:
            aspects = [height / width for height, width in (label.shape, hw)]
            if abs(aspects[0] / aspects[1] - 1) > MOST_STRETCH:
                raise InputError(
                    f"{frame.label} is {label.shape[0]}x{label.shape[1]} pixels and its frame "
                    f"{hw[0]}x{hw[1]}, which is another aspect ratio; use the label of the whole "
                    "frame."
                )
            size = (hw[1], hw[0])
            label = np.asarray(
                cv2.resize(label, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint8
            )
        if self._part(frame) != "train" and self.ignored_test:
            ignored = [self.classes.index(word) for word in self.ignored_test]
            label = np.where(np.isin(label, ignored), np.uint8(IGNORE), label)
        return label


def _check_root(root: Path) -> None:
    if not any(inside(root, part).is_dir() for part in ("train", "test")):
        raise InputError(
            f"dataset.root: '{root}' holds neither the folder train nor test; give the folder into "
            "which both archives were unpacked."
        )


def _check_numbers(crop: tuple[int, int, int, int] | None, thermal_range: tuple[int, int]) -> None:
    if crop is not None and not (0 <= crop[0] < crop[1] and 0 <= crop[2] < crop[3]):
        raise InputError(
            "dataset.crop: expected [first row, row after the last, first column, column after the "
            f"last], such as {list(CROP)}, got {list(crop)}."
        )
    low, high = thermal_range
    if not 0 <= low < high <= np.iinfo(np.uint16).max:
        raise InputError(
            f"dataset.thermal_range: expected counts 0 <= low < high <= 65535, such as "
            f"{list(THERMAL_RANGE)}, got {[low, high]}."
        )
