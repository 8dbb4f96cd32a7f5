"""Read Freiburg Thermal: training days with labels, training nights without, labelled tests.

The reader crops frames, converts thermal counts to grey levels and resizes labels to the frame, as
configured. It refuses files that it cannot read exactly.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.file_dataset import FileDataset, SplitNames, size_of
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.labels import indices
from rgbt.data.patterns import NO_VALUES, Frame, Patterns, WordValues
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
TRAIN = tuple(
    f"train/{{sequence}}/{{piece}}/{kind}/{kind}_{{stamp}}.png"
    for kind in ("fl_rgb", "fl_ir_aligned", "fl_rgb_labels")
)
TEST = (
    "{part}/{time}/ImagesRGB/{stamp}_rgb.png",
    "{part}/{time}/ImagesIR/{stamp}_ir.png",
    "{part}/{time}/SegmentationClass/{stamp}_rgb.npy",
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
LAYOUTS = (
    PairPattern(*TRAIN[:2]),
    PairPattern(*TEST[:2]),
    # Of one part of the archive the stamps of RGB end in a 0 more than those of thermal.
    PairPattern(TEST[0].replace("{stamp}", "{stamp}0"), TEST[1]),
)

MOST_STRETCH = 0.02
"""Largest relative difference of the aspect ratios of label and frame, due to rounding."""

Array = NDArray[np.uint8]
Files = Mapping[tuple[str, ...], Path]
"""Values of the words of a pattern -> file."""


class Freiburg(FileDataset):
    """RGB-thermal street scenes of Freiburg, in the layout of their archives.

    Layout (XX and YY are digits; sec and nsec are seconds and nanoseconds):
        train/seq_XX_{day|night}/YY/fl_rgb/fl_rgb_<sec>_<nsec>.png               8 bit, RGB
                                    fl_ir_aligned/fl_ir_aligned_<sec>_<nsec>.png   16 bit, counts
                                    fl_rgb_labels/fl_rgb_labels_<sec>_<nsec>.png   8 bit, by day
        test/{day|night}/ImagesRGB/*_rgb.png   ImagesIR/*_ir.png   SegmentationClass/*.npy

    Splits: "train_day", "train_night", and "train", which equals "train_day" and is used without
    domains; "val", day sequences that are not in "train_day", if `val_sequences` names any;
    "test_day", "test_night", and "test", the day followed by the night. Training frames at night
    have no labels. Those by day, and so those of "val", carry predictions of an RGB network that
    was trained on Mapillary Vistas; only the test part is labelled by hand.

    Thermal counts c become grey levels of eight bits, round(255 (min(max(c, low), high) - low) /
    (high - low)), halves upwards; a level is 7.5 counts wide with the thesis' range. The thesis
    (Eq. 7) and HeatNet compute the same in real numbers from 0 to 1; the code of the thesis stores
    it with eight bits as well.

    Source: HeatNet (Vertens et al., IROS 2020); crop and range: J. Sun, "RGB-only day-night
    semantic segmentation using domain adaptation with thermal images" (TU Eindhoven, 2022) and its
    code.

    Arguments: the keys of conf/dataset/freiburg.yaml, which describes each. InputError: no such
    root, another layout, or settings that do not fit each other.
    """

    title = "layout of Freiburg Thermal"

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "freiburg",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        unscored: Names = ("background", "ignore"),
        background: Names = ("background", "ignore"),
        crop: Crop | None = CROP,
        thermal_range: CountRange = THERMAL_RANGE,
        ignored_test: Names = ("ignore",),
        val_sequences: Names = (),
    ) -> None:
        super().__init__(
            *(root, name, num_classes, classes, palette),
            background=background,
            unscored=unscored,
        )
        self.check_classes(ignored_test=ignored_test)
        self.crop = crop
        self.ignored_test = ignored_test
        self.val_sequences = val_sequences
        if not {"train", "test"} & {path.name.lower() for path in self.root.iterdir()}:
            raise InputError(
                f"dataset.root: '{root}' holds neither the folder train nor the folder test."
            )
        if crop is not None and not (crop[0] < crop[1] and crop[2] < crop[3]):
            raise InputError(
                "dataset.crop: expected [first row, row after the last, first column, column after "
                f"the last], such as {list(CROP)}, got {list(crop)}."
            )
        if not thermal_range[0] < thermal_range[1]:
            raise InputError(f"dataset.thermal_range: {list(thermal_range)} is no range of counts.")
        self.codes = indices(num_classes)
        self.images = PairReader(
            layouts=LAYOUTS,
            thermal_range=thermal_range,
            counts=True,
            crop=crop,
            advice="use the original file, because a converted file no longer holds the counts "
            "to which dataset.thermal_range applies",
        )

    @property
    def splits(self) -> dict[str, str]:
        """Split -> the pattern of its files."""
        return {key: each for key, each in SPLITS.items() if key != "val" or self.val_sequences}

    def check_split(self, split: str) -> None:
        """Refuse a split that is not one of `splits`, but for "val", which may be empty."""
        if split != "val":
            super().check_split(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in order; InputError if it is unknown or empty."""
        if split == "val" and not self.val_sequences:
            raise InputError("dataset.val_sequences=[]: name the sequences of the split 'val'.")
        return super().names(split)

    def listed(self, split: str) -> tuple[str, ...]:
        """Names of a split, sorted by folder and file, the day before the night.

        Raises:
            InputError: `val_sequences` names none.
        """
        days = [frame for frame in self._frames.values() if _time_of(frame) == "train_day"]
        known = sorted({word for frame in days for word in _sequences(frame)})
        for word in self.val_sequences if known and split in ("train", "train_day", "val") else ():
            check_choice("dataset.val_sequences", word, known)
        return self._of(split)

    def read(self, name: str) -> Sample:
        """See `FileDataset`; cut, thermal as grey levels, without a label in training at night."""
        frame = self.frame(name)
        rgb = self.existing("RGB image", frame.rgb, name)
        thermal = self.existing("thermal image", frame.thermal, name)
        pixels, values = self.images.whole(name, rgb, thermal)
        # A label is resized to the whole frame, and cropped with it.
        label = None if frame.label is None else self._label(frame, frame.label, values.shape)
        sample = self.images.sample(name, pixels, values, thermal)
        if label is None:
            return sample
        return replace(sample, label=np.ascontiguousarray(self.images.cut(label, name)))

    def label(self, name: str) -> Array | None:
        """The label of `read` alone; the frame is read as well, for its size."""
        return self.read(name).label

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        own = {"ignored_test": self.ignored_test, "val_sequences": self.val_sequences}
        return {**super().decoding(), **own, "classes": self.classes}

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each frame is in a night folder; InputError if there is no such frame."""
        return tuple(self.frame(name).values["time"] == "night" for name in names)

    def fingerprint(self) -> str:
        """As `hash_of_files`, with the settings of labels (crop, `ignored_test`)."""
        digest = hashlib.sha256(f"{self.crop} {sorted(self.ignored_test)}\n".encode())
        for split in sorted(SPLITS):
            names = self._of(split)
            digest.update(f"{split} {len(names)} {' '.join(names)}\n".encode())
        for name in self._frames:
            sizes = [size_of(path) for path in self.files(name)]
            digest.update(f"{name} {sizes}\n".encode())
        return digest.hexdigest()

    def frame(self, name: str) -> Frame:
        """The files of `name`; InputError if there is no such frame."""
        if name not in self._frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self._frames[name]

    def repeats(self, split: str) -> bool:
        """The split "train" is "train_day", and "test" the day followed by the night."""
        return split in ("train", "test")

    def unused(self, lists: SplitNames) -> list[Path]:  # noqa: ARG002 - as every data set
        """Thermal images and labels without an RGB image."""
        used = {path for frame in self._frames.values() for path in frame[2:]}
        return [path for path in self._listed[1] if path not in used]

    @property
    def _frames(self) -> dict[str, Frame]:
        """Name -> frame, of training, test by day, test by night."""
        return self._listed[0]

    @cached_property
    def _listed(self) -> tuple[dict[str, Frame], list[Path]]:
        """The frames, and all thermal images and labels; listed once.

        Names are "seq_00_day_00_<seconds>_<nanoseconds>" and "test_night_<...>_<...>"; among the
        values of a frame is its "time".

        Raises:
            InputError: two frames of one name, or two RGB images with one thermal image.
        """
        frames: dict[str, Frame] = {}
        rgb_of: dict[Path, Path] = {}
        partners: list[Path] = []
        tests = ({"part": "test", "time": time} for time in ("day", "night"))
        for texts, known in ((TRAIN, NO_VALUES), *((TEST, values) for values in tests)):
            rgb, *others = Patterns.of(*texts)
            thermals, labels = (
                {tuple(v.values()): path for path, v in each.files(self.root, known, any_case=True)}
                for each in others
                if each is not None
            )
            partners += [*thermals.values(), *labels.values()]
            for path, values in rgb.files(self.root, known, any_case=True):
                frame = self._frame(path, values, thermals, labels)
                if frame.name in frames or frame.thermal in rgb_of:
                    raise InputError(
                        f"{path}: another frame is called '{frame.name}' too, or has the same "
                        f"thermal image {frame.thermal}; remove or rename one."
                    )
                frames[frame.name], rgb_of[frame.thermal] = frame, path
        return frames, partners

    def _frame(self, rgb: Path, values: WordValues, thermals: Files, labels: Files) -> Frame:
        """The files of an RGB image; `values` has its part and time if it is of the test part."""
        words, is_test = tuple(values.values()), "part" in values
        times = [t for t in ("day", "night") if t in values.get("sequence", values.get("time", ""))]
        if len(times) != 1:
            raise InputError(
                f"{rgb}: expected a sequence with day or night in its name, such as seq_00_day."
            )
        expected = Patterns.of(*(TEST if is_test else TRAIN)).frame(self.root, "", values)
        # Stamps of RGB and label end in the number of the frame in its burst, always 0. Stamps of
        # thermal images do so in one part of the archive only.
        without = (*words[:-1], words[-1].removesuffix("0")) if is_test else words
        return Frame(
            name="_".join(words),
            values={**values, "time": times[0]},
            rgb=rgb,
            thermal=thermals.get(words) or thermals.get(without) or expected.thermal,
            label=labels.get(words, expected.label) if is_test or times == ["day"] else None,
        )

    def _of(self, split: str) -> tuple[str, ...]:
        part = {"train": "train_day", "val": "val_day"}.get(split, split)
        frames = self._frames.items()
        return tuple(name for name, frame in frames if self._part(frame).startswith(part))

    def _part(self, frame: Frame) -> str:
        """The part and time of a frame: "val_day" of training days that are held out."""
        time = _time_of(frame)
        held_out = time == "train_day" and set(_sequences(frame)) & set(self.val_sequences)
        return "val_day" if held_out else time

    def _label(self, frame: Frame, path: Path, hw: tuple[int, ...]) -> Array:
        """The label, resized to the frame with the nearest pixel."""
        label = self.codes.read(self.existing("label", path, frame.name))
        if label.shape != hw:
            aspects = [height / width for height, width in (label.shape, hw)]
            if abs(aspects[0] / aspects[1] - 1) > MOST_STRETCH:
                raise InputError(
                    f"{path} has {label.shape[0]}x{label.shape[1]} pixels but its frame "
                    f"{hw[0]}x{hw[1]}, which is another aspect ratio; use the label of the whole "
                    "frame."
                )
            size = (hw[1], hw[0])
            label = np.asarray(
                cv2.resize(label, size, interpolation=cv2.INTER_NEAREST_EXACT), np.uint8
            )
        if not self._part(frame).startswith("train") and self.ignored_test:
            ignored = [self.classes.index(word) for word in self.ignored_test]
            label = np.where(np.isin(label, ignored), np.uint8(IGNORE), label)
        return label


def _time_of(frame: Frame) -> str:
    """The part of the archive and the time of a frame: "train_night"."""
    return f"{frame.values.get('part', 'train')}_{frame.values['time']}"


def _sequences(frame: Frame) -> tuple[str, str]:
    """The training sequence of a frame, and the piece of it: "seq_00_day", "seq_00_day/00"."""
    sequence = frame.values["sequence"]
    return sequence, f"{sequence}/{frame.values['piece']}"
