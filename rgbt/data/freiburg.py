"""Read Freiburg Thermal: training days with labels, training nights without, labelled tests."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice
from rgbt.data.file_dataset import FileDataset, SplitNames, size_of
from rgbt.data.images import PairReader
from rgbt.data.labels import indices
from rgbt.data.patterns import FrameFiles, Patterns, WordValues
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

# Class -> its colour, in the order of the indices.
COLOURS = {
    "road": (128, 64, 128),
    "sidewalk": (244, 35, 232),
    "building": (70, 70, 70),
    "curb": (196, 196, 196),
    "fence": (190, 153, 153),
    "pole": (153, 153, 153),
    "vegetation": (107, 142, 35),
    "terrain": (152, 251, 152),
    "sky": (70, 130, 180),
    "person": (220, 20, 60),
    "car": (0, 0, 142),
    "bicycle": (119, 11, 32),
    "background": (138, 43, 226),
    "ignore": (0, 0, 0),
}
CLASSES, PALETTE = tuple(COLOURS), tuple(COLOURS.values())
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
    Patterns.of(*TRAIN[:2]),
    Patterns.of(*TEST[:2]),
    # In one part of the archive, the stamps of RGB end in a 0 more than those of thermal.
    Patterns.of(TEST[0].replace("{stamp}", "{stamp}0"), TEST[1]),
)

# Largest relative difference of the aspect ratios of label and frame, due to rounding.
MOST_STRETCH = 0.02

Array = NDArray[np.uint8]


class Freiburg(FileDataset):
    """Reads RGB-thermal street scenes of Freiburg, in the layout of their archives.

    Layout (XX and YY are digits; sec and nsec are seconds and nanoseconds):
        train/seq_XX_{day|night}/YY/fl_rgb/fl_rgb_<sec>_<nsec>.png               8 bit, RGB
                                    fl_ir_aligned/fl_ir_aligned_<sec>_<nsec>.png   16 bit, counts
                                    fl_rgb_labels/fl_rgb_labels_<sec>_<nsec>.png   8 bit, by day
        test/{day|night}/ImagesRGB/*_rgb.png   ImagesIR/*_ir.png   SegmentationClass/*.npy

    The split "train" equals "train_day" and is used without domains; "val" are the day sequences
    that `val_sequences` takes out of both; "test" is the day followed by the night. Training frames
    at night have no labels. Those by day carry predictions of an RGB network that was trained on
    Mapillary Vistas; only the test part is labelled by hand.

    Thermal counts become grey levels of eight bits (`rgbt.data.images.grey`), 7.5 counts wide with
    the thesis' range. The thesis (Eq. 7) and HeatNet compute the same in real numbers from 0 to 1;
    the code of the thesis stores it with eight bits as well.

    Source: HeatNet (Vertens et al., IROS 2020); crop and range: J. Sun, "RGB-only day-night
    semantic segmentation using domain adaptation with thermal images" (TU Eindhoven, 2022) and its
    code.
    """

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
        common = (root, name, num_classes, classes, palette)
        super().__init__(*common, background=background, unscored=unscored)
        self.check_classes(ignored_test=ignored_test)
        self.ignored_test, self.val_sequences = ignored_test, val_sequences
        if not {"train", "test"} & {path.name.lower() for path in self.root.iterdir()}:
            raise InputError(f"dataset.root: '{root}' holds neither the folder train nor test.")
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
            crop=crop,
            advice="use the original file, which holds the counts of dataset.thermal_range",
        )
        self.splits = SPLITS
        self._frames: dict[str, FrameFiles] = {}
        self._partners: list[Path] = []
        self._list()

    def listed(self, split: str) -> tuple[str, ...]:
        """Return a split's names, sorted, day first; InputError if `val_sequences` names none."""
        days = [f for f in self._frames.values() if f.values["part"] in ("train_day", "val_day")]
        known = sorted({word for frame in days for word in _sequences(frame.values)})
        for word in self.val_sequences if known and split in ("train", "train_day", "val") else ():
            check_choice("dataset.val_sequences", word, known)
        return self._of(split)

    def label(self, name: str) -> Array | None:
        """Return the label of `read` alone; the frame is read as well, for its size."""
        return self.read(name).label

    def fitted(self, label: Array, frame: FrameFiles, hw: tuple[int, ...]) -> Array:
        """Resize the label to the frame, nearest; in tests, some classes become ignored.

        InputError for another aspect ratio.
        """
        if label.shape != hw:
            aspects = [height / width for height, width in (label.shape, hw)]
            if abs(aspects[0] / aspects[1] - 1) > MOST_STRETCH:
                raise InputError(
                    f"{frame.label} has {label.shape[0]}x{label.shape[1]} pixels but its frame "
                    f"{hw[0]}x{hw[1]}, which is another aspect ratio."
                )
            resized = cv2.resize(label, hw[::-1], interpolation=cv2.INTER_NEAREST_EXACT)
            label = np.asarray(resized, np.uint8)
        if not frame.values["part"].startswith("train") and self.ignored_test:
            ignored = [self.classes.index(word) for word in self.ignored_test]
            label = np.where(np.isin(label, ignored), np.uint8(IGNORE), label)
        return label

    def decoding(self) -> dict[str, Any]:
        """Return the settings that change what `read` makes of the files."""
        own = {"ignored_test": self.ignored_test, "val_sequences": self.val_sequences}
        return {**super().decoding(), **own, "classes": self.classes}

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Say which frames are in a night folder; InputError if there is no such frame."""
        return tuple(self.frame(name).values["part"].endswith("night") for name in names)

    def fingerprint(self) -> str:
        """Return a digest of names, sizes of files and settings (crop, `ignored_test`)."""
        digest = hashlib.sha256(f"{self.images.crop} {sorted(self.ignored_test)}\n".encode())
        for split in sorted(SPLITS):
            names = self._of(split)
            digest.update(f"{split} {len(names)} {' '.join(names)}\n".encode())
        for name in self._frames:
            sizes = [size_of(path) for path in self.files(name)]
            digest.update(f"{name} {sizes}\n".encode())
        return digest.hexdigest()

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`; InputError if there is no such frame."""
        if name not in self._frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self._frames[name]

    def repeats(self, split: str) -> bool:
        """Say whether a split repeats others: "train", "test", and "val" without sequences."""
        return split in ("train", "test") or (split == "val" and not self.val_sequences)

    def unused(self, lists: SplitNames) -> list[Path]:  # noqa: ARG002 - as every data set
        """Return thermal images and labels without an RGB image."""
        used = {path for frame in self._frames.values() for path in frame[2:]}
        return [path for path in self._partners if path not in used]

    def _list(self) -> None:
        """Find the frames of training, test by day, test by night, and all their partners.

        Names are "seq_00_day_00_<seconds>_<nanoseconds>" and "test_night_<...>_<...>". The value
        "part" of a frame is "train_day", "train_night", "val_day" (of training days that are held
        out), "test_day" or "test_night". InputError: two frames of one name or thermal image.
        """
        used: set[Path] = set()
        tests = ({"part": "test", "time": time} for time in ("day", "night"))
        for texts, known in ((TRAIN, {}), *((TEST, values) for values in tests)):
            patterns = Patterns.of(*texts)
            rgb, *others = [
                pattern.files(self.root, known, any_case=True) for pattern in patterns if pattern
            ]
            for files in others:
                self._partners += files
            thermals, labels = [
                {tuple(values.values()): path for path, values in files.items()} for files in others
            ]
            for path, values in rgb.items():
                words = tuple(values.values())
                sequence = values.get("sequence", values.get("time", ""))
                times = [time for time in ("day", "night") if time in sequence]
                if len(times) != 1:
                    raise InputError(f"{path}: expected day or night in the name of a sequence.")
                part = f"{values.get('part', 'train')}_{times[0]}"
                if part == "train_day" and set(_sequences(values)) & set(self.val_sequences):
                    part = "val_day"
                # Stamps of RGB and label end in the number of the frame in its burst, always 0.
                # Stamps of thermal images do so in one part of the archive only.
                is_test = part.startswith("test")
                without = (*words[:-1], words[-1].removesuffix("0")) if is_test else words
                expected = patterns.frame(self.root, "", values)
                frame = FrameFiles(
                    name="_".join(words),
                    values={**values, "part": part},
                    rgb=path,
                    thermal=thermals.get(words) or thermals.get(without) or expected.thermal,
                    label=None if part == "train_night" else labels.get(words, expected.label),
                )
                if frame.name in self._frames or frame.thermal in used:
                    raise InputError(
                        f"{path}: another frame is called '{frame.name}' too, or has the same "
                        f"thermal image {frame.thermal}; remove or rename one."
                    )
                self._frames[frame.name] = frame
                used.add(frame.thermal)

    def _of(self, split: str) -> tuple[str, ...]:
        part = {"train": "train_day", "val": "val_day"}.get(split, split)
        frames = self._frames.items()
        return tuple(name for name, frame in frames if frame.values["part"].startswith(part))


def _sequences(values: WordValues) -> tuple[str, str]:
    """Return a frame's training sequence and the piece of it: "seq_00_day", "seq_00_day/00"."""
    return values["sequence"], f"{values['sequence']}/{values['piece']}"
