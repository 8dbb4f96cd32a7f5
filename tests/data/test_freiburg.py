"""Freiburg Thermal: frames, partners, labels, and what the check finds in a copy."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.data.check import check_dataset
from rgbt.data.freiburg import Freiburg
from tests.conftest import write_png
from tests.data.layouts import (
    CROP,
    FREIBURG_HW,
    contents,
    freiburg,
    of_freiburg,
    refused,
    write_freiburg,
    write_test,
    write_training,
)

DAY, TEST = "seq_00_day_00_1570_0000", "test_day_1578_0080"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_freiburg(tmp_path / "freiburg")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for tests that write nothing."""
    return write_freiburg(tmp_path_factory.mktemp("sound") / "freiburg")


def stamp_of(name: str) -> str:
    return "_".join(name.split("_")[-2:])


def cut(image: np.ndarray) -> np.ndarray:
    return image[1:12, 5:23]


def levels(counts: np.ndarray) -> np.ndarray:
    """By the thesis' range, in real numbers, halves upwards."""
    grey = np.clip((counts.astype(float) - 21800) / 1900, 0, 1) * 255
    return np.asarray(np.floor(grey + 0.5))


def test_splits_by_folder(sound: Path) -> None:
    dataset = freiburg(sound)
    names = {split: dataset.names(split) for split in dataset.splits}
    assert names["train"] == names["train_day"]
    assert names["train_day"] == (DAY, "seq_00_day_00_1571_0010", "seq_00_day_01_1572_0020")
    assert names["val"] == ("seq_04_day_00_1573_0030", "seq_04_day_00_1574_0040")
    assert names["train_night"][0] == "seq_00_night_00_1575_0050"
    assert names["test_day"] == (TEST, "test_day_1579_0090")
    assert names["test"] == names["test_day"] + names["test_night"]
    assert dataset.nights(names["train_day"]) == (False,) * 3
    assert dataset.nights(names["train_night"]) == (True,) * 3
    assert dataset.nights(names["test"]) == (False, False, True, True)
    assert "has no frame called 'other'" in refused(lambda: dataset.nights(("other",)))


@pytest.mark.parametrize("time", ["day", "night"])
def test_stamp_of_thermal_may_lack_last_zero(tmp_path: Path, time: str) -> None:
    write_test(tmp_path, time, "1570_120", thermal="1570_12")
    write_test(tmp_path, time, "1571_130", thermal="1571_130")
    dataset = freiburg(tmp_path)
    for name, partner in zip(dataset.names("test"), ("1570_12", "1571_130"), strict=True):
        assert dataset.frame(name).thermal.name == f"{partner}_ir.png"
        counts = of_freiburg(stamp_of(name))[1]
        assert np.array_equal(dataset.read(name).thermal, levels(cut(counts)))
        assert dataset.read(name).label is not None
    write_test(tmp_path, time, "1570_12")
    assert "the same thermal image" in refused(lambda: freiburg(tmp_path))


@pytest.mark.parametrize("split", ["train_day", "val", "test_night"])
def test_reads_what_lies_there(sound: Path, split: str) -> None:
    dataset = freiburg(sound, ignored_test=())
    name = dataset.names(split)[0]
    rgb, counts, label = of_freiburg(stamp_of(name))
    sample = dataset.read(name)
    assert (sample.rgb.dtype, sample.thermal.dtype, sample.label.dtype) == (np.uint8,) * 3
    assert np.array_equal(sample.rgb, cut(rgb))
    assert np.array_equal(sample.thermal, levels(cut(counts)))
    assert np.array_equal(sample.label, cut(label))
    assert np.array_equal(dataset.label(name), sample.label)
    assert dataset.read(dataset.names("train_night")[0]).label is None
    whole = freiburg(sound, crop=None).read(DAY)
    assert np.array_equal(whole.rgb, of_freiburg("1570_0000")[0])


@pytest.mark.parametrize(
    ("count", "thesis", "heatnet"),
    [
        # (c - 21800) 255 / 1900 and / 3200; 22750 is the middle of the first: 127.5, upwards.
        (21804, 1, 0),  # 0.537, 0.319
        (22750, 128, 76),  # 127.5, 75.70
        (23697, 255, 151),  # 254.597, 151.17
        (65535, 255, 255),
    ],
)
def test_counts_are_clipped_and_scaled(root: Path, count: int, thesis: int, heatnet: int) -> None:
    write_png(freiburg(root).frame(DAY).thermal, np.full(FREIBURG_HW, count, np.uint16))
    assert set(freiburg(root).read(DAY).thermal.flat) == {thesis}
    assert set(freiburg(root, thermal_range=(21800, 25000)).read(DAY).thermal.flat) == {heatnet}
    write_png(freiburg(root).frame(DAY).thermal, np.full(FREIBURG_HW, 85, np.uint8))
    assert "got 8 bits; use the original file" in refused(lambda: freiburg(root).read(DAY))


@pytest.mark.parametrize(
    ("label", "said"),
    [
        (np.full(FREIBURG_HW, -1), "label value -1 "),
        (np.full(FREIBURG_HW, 256 + 3), "label value 259 "),
        (np.zeros(FREIBURG_HW), "whole numbers of shape (rows, columns), got (13, 26) float64"),
        (np.array({}), "cannot be read as an array"),
        (np.zeros((26, 13), int), "has 26x13 pixels but its frame 13x26, which is another aspect"),
        (np.zeros((13, 24), int), "another aspect ratio"),
        (np.zeros((11, 26), int), "another aspect ratio"),
    ],
)
def test_label_arrays_without_classes_are_refused(root: Path, label: np.ndarray, said: str) -> None:
    dataset = freiburg(root)
    np.save(dataset.files(TEST)[-1], label)
    assert said in refused(lambda: dataset.read(TEST))


@pytest.mark.parametrize("hw", [(39, 78), (15, 30), (11, 22)])
def test_label_of_other_size_is_resized(root: Path, hw: tuple[int, int]) -> None:
    dataset = freiburg(root, crop=None, ignored_test=())
    label = contents("label", hw, 14)[2]
    write_png(dataset.files(DAY)[-1], label)
    np.save(dataset.files(TEST)[-1], label.astype(np.int16))
    # The middle of pixel x of n is in pixel (x + 0.5) m / n, rounded down, of m.
    rows, columns = (
        np.floor((np.arange(n) + 0.5) * m / n).astype(int)
        for n, m in zip(FREIBURG_HW, hw, strict=True)
    )
    for name in (DAY, TEST):
        assert np.array_equal(dataset.label(name), label[np.ix_(rows, columns)])


@pytest.mark.parametrize(
    ("ignored", "gone"), [(("ignore",), [13]), ((), []), (("background", "ignore"), [12, 13])]
)
def test_ignored_test_applies_to_test_only(
    sound: Path, ignored: tuple[str, ...], gone: list[int]
) -> None:
    dataset = freiburg(sound, ignored_test=ignored, crop=None)
    for split, counts in (("train_day", False), ("val", True), ("test", True)):
        for name in dataset.names(split):
            label = of_freiburg(stamp_of(name))[2]
            if counts:
                label[np.isin(label, gone)] = 255
            assert np.array_equal(dataset.label(name), label)


def test_fingerprint_is_of_labels_too(sound: Path) -> None:
    expected = freiburg(sound).fingerprint()
    assert freiburg(sound, thermal_range=(21800, 25000)).fingerprint() == expected
    changes = ({"crop": None}, {"ignored_test": ()}, {"val_sequences": ("seq_00_day",)})
    others = {freiburg(sound, **changed).fingerprint() for changed in changes}
    assert len({expected, *others}) == 4


def test_sequences_that_are_held_out(sound: Path, tmp_path: Path) -> None:
    dataset = Freiburg(str(sound), crop=CROP, background=("background",))
    assert (dataset.background, len(dataset.unscored)) == (("background",), 2)
    assert len(dataset.names("train_day")) == len(dataset.names("train")) == 5
    assert not dataset.has("val")
    assert "dataset.val_sequences" in refused(lambda: dataset.names("val"))
    report = check_dataset(dataset)
    assert report.problems == ()
    night = report.splits["train_night"]
    assert (night.read, night.unlabelled, night.day, night.night) == (3, 3, 0, 3)
    assert night.sizes == {(11, 18): 3}
    held_out = freiburg(sound, val_sequences=("seq_00_night",))
    said = refused(lambda: held_out.names("val"))
    assert "dataset.val_sequences: 'seq_00_night' is not a valid" in said
    assert len(held_out.names("test")) == 4  # another archive
    write_training(tmp_path, "seq_04_day/00", "1_0")
    for split in ("train_night", "test", "train"):
        assert not freiburg(tmp_path).has(split)


def test_check_leaves_out_what_the_crop_cuts_off(tmp_path: Path) -> None:
    """The black margins of aligned thermal images are no missing data, if nobody sees them."""
    root = write_freiburg(tmp_path)
    for path in root.rglob("*_ir*.png"):
        counts = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        kept = counts[slice(*CROP[:2]), slice(*CROP[2:])].copy()
        counts[:] = 0
        counts[slice(*CROP[:2]), slice(*CROP[2:])] = kept
        write_png(path, counts)
    assert "no data" not in " ".join(check_dataset(freiburg(root)).notes)
    assert "value 0 is far" in " ".join(check_dataset(freiburg(root, crop=None)).notes)


def test_folders_in_other_capitals_and_without_a_time(tmp_path: Path) -> None:
    write_test(
        tmp_path, "night", "1570_120", folders=("imagesrgb", "IMAGESIR", "Segmentationclass")
    )
    assert freiburg(tmp_path).names("test_night") == ("test_night_1570_120",)
    assert freiburg(tmp_path).read("test_night_1570_120").label is not None
    write_training(tmp_path, "seq_05_dusk/00", "1_0")
    assert "expected day or night in the name" in refused(lambda: freiburg(tmp_path))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"crop": (5, 5, 0, 1)}, "dataset.crop: expected [first row, row after the last, "),
        ({"crop": (0, 5, 9, 1)}, "dataset.crop: expected"),
        ({"crop": (0, 14, 0, 26)}, "dataset.crop=[0, 14, 0, 26] reaches to row 14"),
        ({"crop": (0, 13, 5, 27)}, "has 13x26 pixels"),
        ({"thermal_range": (23700, 21800)}, "dataset.thermal_range: "),
        ({"ignored_test": ("ignored",)}, "dataset.ignored_test: 'ignored' is not a valid choice"),
    ],
)
def test_wrong_settings_are_named(sound: Path, wrong: dict[str, Any], said: str) -> None:
    assert said in refused(lambda: freiburg(sound, **wrong).read(DAY))
