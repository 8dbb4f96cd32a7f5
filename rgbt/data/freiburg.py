"""Read Freiburg Thermal: training days with labels, training nights without, labelled tests.

The reader crops frames, converts thermal counts to grey levels and resizes labels to the frame, as
configured. It refuses files that it cannot read exactly.
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

from rgbt.checks import InputError, nearest
from rgbt.data.file_dataset import FileDataset, SplitNames
from rgbt.data.folder.frames import FolderFrame
from rgbt.data.freiburg_layout import TEST, TRAIN, find_frames, inside
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.labels import indices
from rgbt.data.named_files import existing_file, existing_root, size_of
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
LAYOUTS = (
    PairPattern(*TRAIN[:2]),
    PairPattern(*TEST[:2]),
    # Of one part of the archive the stamps of RGB end in a 0 more than those of thermal.
    PairPattern(TEST.rgb.replace("{stamp}", "{stamp}0"), TEST.thermal),
)

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

    Args:
        root: folder that holds `train`, `test` or both.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        unscored: classes that are counted but left out of every mean over classes.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        crop: first row, row after the last, first column, column after the last of the part of
            every frame and label that is used; None: whole frames.
        thermal_range: (low, high) counts that become black and white: [21800, 23700] in the thesis,
            [21800, 25000] in the HeatNet release.
        ignored_test: classes that are ignored in "val" and "test" (they become 255):
            "ignore" in HeatNet, none in the code of the thesis. In training they stay classes.
        val_sequences: day sequences ("seq_04_day") or pieces of them ("seq_03_day/00") that form
            "val". (): all 12,170 frames by day are for training, as in the thesis and its port of
            HeatNet, and there is no "val".

    Raises:
        InputError: no such root, neither part in it, an invalid crop, range or class, or numbers of
            classes, names and colours that differ.
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
        folder = existing_root(root, "that holds train and test")
        super().__init__(
            *(folder, name, num_classes, classes, palette),
            background=background,
            unscored=unscored,
        )
        self.check_classes(ignored_test=ignored_test)
        self.crop = crop
        self.ignored_test = ignored_test
        self.val_sequences = val_sequences
        self._split_frames: dict[str, tuple[FolderFrame, ...]] = {}
        if not any(inside(folder, part).is_dir() for part in ("train", "test")):
            raise InputError(
                f"dataset.root: '{root}' holds neither the folder train nor the folder test; give "
                "the folder into which both archives were unpacked."
            )
        if crop is not None and not (0 <= crop[0] < crop[1] and 0 <= crop[2] < crop[3]):
            raise InputError(
                "dataset.crop: expected [first row, row after the last, first column, column after "
                f"the last], such as {list(CROP)}, got {list(crop)}."
            )
        if not 0 <= thermal_range[0] < thermal_range[1] < 2**16:
            raise InputError(
                "dataset.thermal_range: expected counts 0 <= low < high <= 65535, such as "
                f"{list(THERMAL_RANGE)}, got {list(thermal_range)}."
            )
        self.codes = indices(num_classes)
        self.clipping = thermal_range
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

    def has(self, split: str) -> bool:
        """Whether `split` has frames; InputError if the split is unknown ("val" is known)."""
        return bool(self._of(split))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, sorted by folder and file, the day before the night.

        Raises:
            InputError: unknown split, no frame of it, a missing sequence of "val".
        """
        frames = self._of(split)
        if split == "val" and not self.val_sequences:
            raise InputError(
                f"{self.name} has no validation split, because dataset.val_sequences=[]; name day "
                "sequences that are held out of training, such as "
                "dataset.val_sequences=[seq_04_day]."
            )
        hint = f"unpack the archive '{split.partition('_')[0]}' there"
        if split in ("train", "train_day", "val"):
            by_day = [each for each in self._frames.values() if _time_of(each) == "train_day"]
            known = {word for frame in by_day for word in _sequences(frame)}
            for word in self.val_sequences if by_day else ():
                if word not in known:
                    raise InputError(
                        f"dataset.val_sequences: there is no day sequence '{word}' in {self.root}; "
                        f"{nearest(word, {each for each in known if '/' not in each})}."
                    )
            if split == "val":
                hint = (
                    f"dataset.val_sequences is {list(self.val_sequences)}; name existing day "
                    "sequences"
                )
            elif by_day:
                hint = "every day sequence is in dataset.val_sequences; remove one of them"
        if not frames:
            raise InputError(
                f"split '{split}' of {self.name} is empty: expected {self.splits[split]} in "
                f"{self.root}; {hint}."
            )
        return tuple(frame.name for frame in frames)

    def read(self, name: str) -> Sample:
        """See `FileDataset`; cut, thermal as grey levels, without a label in training at night."""
        frame = self.frame(name)
        rgb = existing_file("RGB image", frame.rgb, name, self.root)
        thermal = existing_file("thermal image", frame.thermal, name, self.root)
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
        return {
            **super().decoding(),
            "ignored_test": sorted(self.ignored_test),
            "val_sequences": sorted(self.val_sequences),
            "classes": self.classes,
        }

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each frame is in a night folder; InputError if there is no such frame."""
        return tuple(self.frame(name).values["time"] == "night" for name in names)

    def fingerprint(self) -> str:
        """As `hash_of_files`, with the settings of labels (crop, `ignored_test`)."""
        digest = hashlib.sha256(f"{self.crop} {sorted(self.ignored_test)}\n".encode())
        for split in sorted(SPLITS):
            names = [frame.name for frame in self._of(split)]
            digest.update(f"{split} {len(names)} {' '.join(names)}\n".encode())
        for name in self._frames:
            sizes = [size_of(path) for path in self.files(name)]
            digest.update(f"{name} {sizes}\n".encode())
        return digest.hexdigest()

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; InputError if there is no such frame."""
        if name not in self._frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self._frames[name]

    def repeats(self, split: str) -> bool:
        """The split "train" is "train_day", and "test" the day followed by the night."""
        return split in ("train", "test")

    def unused(self, lists: SplitNames) -> list[Path]:  # noqa: ARG002 - as every data set
        """Thermal images and labels without an RGB image."""
        return self._frames_and_unused[1]

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Frames in two parts, by their time stamps; names differ between the parts."""

        def forms(name: str) -> tuple[str, str]:
            """The stamp without and with the number in the burst, which may be left out."""
            stamp = self.frame(name).values["stamp"]
            return stamp.removesuffix("0"), stamp

        problems = []
        for test in ("test_day", "test_night"):
            for other in ("train_day", "train_night", "val"):
                trained = {form: name for name in lists.get(other, ()) for form in forms(name)}
                both = [name for name in lists.get(test, ()) if forms(name)[0] in trained]
                problems += [
                    f"splits {test} and {other} share {len(both)} frames by their time stamps; "
                    f"the first is '{name}', which is '{trained[forms(name)[0]]}'."
                    for name in both[:1]
                ]
        return problems

    @cached_property
    def _frames_and_unused(self) -> tuple[dict[str, FolderFrame], list[Path]]:
        """See `find_frames`; listed once, so later changes of the folder have no effect."""
        return find_frames(self.root)

    @property
    def _frames(self) -> dict[str, FolderFrame]:
        return self._frames_and_unused[0]

    def _of(self, split: str) -> tuple[FolderFrame, ...]:
        if split != "val":  # empty by choice where no sequence is held out
            self.check_split(split)
        if split not in self._split_frames:
            wanted = {"train": "train_day", "val": "val_day"}.get(split, split)
            self._split_frames[split] = tuple(
                frame for frame in self._frames.values() if self._part(frame).startswith(wanted)
            )
        return self._split_frames[split]

    def _part(self, frame: FolderFrame) -> str:
        """The part and time of a frame: "val_day" of training days that are held out."""
        time = _time_of(frame)
        held_out = time == "train_day" and set(_sequences(frame)) & set(self.val_sequences)
        return "val_day" if held_out else time

    def _label(self, frame: FolderFrame, path: Path, hw: tuple[int, ...]) -> Array:
        """The label, resized to the frame with the nearest pixel."""
        label = self.codes.read(existing_file("label", path, frame.name, self.root))
        if label.shape != hw:
            aspects = [height / width for height, width in (label.shape, hw)]
            if abs(aspects[0] / aspects[1] - 1) > MOST_STRETCH:
                raise InputError(
                    f"{path} has {label.shape[0]}x{label.shape[1]} pixels but its frame "
                    f"{hw[0]}x{hw[1]}, which is another aspect ratio. Use the label of the whole "
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


def _time_of(frame: FolderFrame) -> str:
    """The part of the archive and the time of a frame: "train_night"."""
    return f"{frame.values.get('part', 'train')}_{frame.values['time']}"


def _sequences(frame: FolderFrame) -> tuple[str, str]:
    """The training sequence of a frame, and the piece of it: "seq_00_day", "seq_00_day/00"."""
    sequence = frame.values["sequence"]
    return sequence, f"{sequence}/{frame.values['piece']}"
