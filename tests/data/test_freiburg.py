"""Freiburg Thermal: frames, partners, labels, and what the check finds in a copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.check import check_dataset
from rgbt.data.freiburg import Freiburg
from tests.conftest import write_png
from tests.data import freiburg_files as files
from tests.data.freiburg_files import reader, write_freiburg


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_freiburg(tmp_path / "freiburg")


def path_of(dataset: Freiburg, name: str, kind: str) -> Path:
    path = getattr(dataset.frame(name), kind)
    assert isinstance(path, Path)
    return path


def test_splits_by_folder(root: Path) -> None:
    dataset = reader(root)
    names = {split: dataset.names(split) for split in dataset.splits}
    assert names["train"] == names["train_day"]
    assert names["train_day"] == (
        "seq_00_day_00_1570_0000",
        "seq_00_day_00_1571_0010",
        "seq_00_day_01_1572_0020",
    )
    assert names["val"] == ("seq_04_day_00_1573_0030", "seq_04_day_00_1574_0040")
    assert names["train_night"][0] == "seq_00_night_00_1575_0050"
    assert len(names["train_night"]) == 3
    assert names["test_day"] == ("test_day_1578_0080", "test_day_1579_0090")
    assert names["test"] == names["test_day"] + names["test_night"]
    assert all(dataset.has(split) for split in dataset.splits)


def test_night_is_what_the_path_says(root: Path) -> None:
    dataset = reader(root)
    assert dataset.nights(dataset.names("train_day")) == (False,) * 3
    assert dataset.nights(dataset.names("train_night")) == (True,) * 3
    assert dataset.nights(dataset.names("test")) == (False, False, True, True)
    with pytest.raises(InputError, match="has no frame called 'other'"):
        dataset.nights(("other",))


@pytest.mark.parametrize("time", ["day", "night"])
def test_stamp_of_thermal_may_lack_last_zero(tmp_path: Path, time: str) -> None:
    files.write_test(tmp_path, time, "1570_120", thermal="1570_12")
    files.write_test(tmp_path, time, "1571_130", thermal="1571_130")
    dataset = reader(tmp_path)
    for name, partner in zip(dataset.names("test"), ("1570_12", "1571_130"), strict=True):
        assert path_of(dataset, name, "thermal").name == f"{partner}_ir.png"
        stamp = name.removeprefix(f"test_{time}_")
        counts = np.clip(files.contents(stamp)[1][1:12, 5:23].astype(float) - 21800, 0, 1900)
        assert np.array_equal(dataset.read(name).thermal, np.floor(counts / 1900 * 255 + 0.5))
        assert dataset.read(name).label is not None


def test_shared_thermal_image_is_refused(tmp_path: Path) -> None:
    files.write_test(tmp_path, "day", "1570_120", thermal="1570_12")
    files.write_test(tmp_path, "day", "1570_12")
    with pytest.raises(InputError, match=r"the same thermal image .*1570_12_ir.png"):
        reader(tmp_path).names("test")


@pytest.mark.parametrize("split", ["train_day", "val", "test_night"])
def test_reads_what_lies_there(root: Path, split: str) -> None:
    dataset = reader(root, ignored_test=())
    name = dataset.names(split)[0]
    rgb, counts, label = files.contents("_".join(name.split("_")[-2:]))
    sample = dataset.read(name)
    assert sample.name == name
    assert (sample.rgb.dtype, sample.thermal.dtype) == (np.uint8, np.uint8)
    assert np.array_equal(sample.rgb, rgb[1:12, 5:23])
    grey = np.clip((counts[1:12, 5:23].astype(float) - 21800) / 1900, 0, 1) * 255
    assert np.array_equal(sample.thermal, np.floor(grey + 0.5))
    assert sample.label is not None
    assert sample.label.dtype == np.uint8
    assert np.array_equal(sample.label, label[1:12, 5:23])
    assert np.array_equal(dataset.label(name), sample.label)
    assert dataset.read(dataset.names("train_night")[0]).label is None


@pytest.mark.parametrize(
    ("count", "thesis", "heatnet"),
    [
        # (c - 21800) 255 / 1900 and / 3200; 22750 is the middle of the first: 127.5, upwards.
        (0, 0, 0),
        (21800, 0, 0),
        (21803, 0, 0),  # 0.403
        (21804, 1, 0),  # 0.537, 0.319
        (22750, 128, 76),  # 127.5, 75.70
        (23000, 161, 96),  # 161.05, 95.6
        (23696, 254, 151),  # 254.46, 151.09
        (23697, 255, 151),  # 254.597, 151.17
        (23700, 255, 151),
        (24000, 255, 175),  # 175.31
        (25000, 255, 255),
        (65535, 255, 255),
    ],
)
def test_counts_are_clipped_and_scaled(root: Path, count: int, thesis: int, heatnet: int) -> None:
    name = "seq_00_day_00_1570_0000"
    write_png(path_of(reader(root), name, "thermal"), np.full(files.HW, count, np.uint16))
    assert set(reader(root).read(name).thermal.flat) == {thesis}
    assert set(reader(root, thermal_range=(21800, 25000)).read(name).thermal.flat) == {heatnet}


@pytest.mark.parametrize(
    "image", [np.full(files.HW, 85, np.uint8), np.zeros((*files.HW, 3), np.uint8)]
)
def test_thermal_images_without_counts_are_refused(root: Path, image: np.ndarray) -> None:
    dataset = reader(root)
    name = dataset.names("train_night")[1]
    write_png(path_of(dataset, name, "thermal"), image)
    with pytest.raises(InputError, match="expected a thermal image of 16 bits .* one channel"):
        dataset.read(name)


@pytest.mark.parametrize(
    ("label", "said"),
    [
        (np.full(files.HW, 14), "label value 14 "),
        (np.full(files.HW, -1), "label value -1 "),
        (np.full(files.HW, 256 + 3), "label value 259 "),
        (np.zeros(files.HW), r"whole numbers of shape \(rows, columns\), got \(13, 26\) float64"),
        (np.zeros((*files.HW, 3), int), r"got \(13, 26, 3\) int64"),
        (np.array({}), "cannot be read as an array"),
    ],
)
def test_label_arrays_without_classes_are_refused(root: Path, label: np.ndarray, said: str) -> None:
    dataset = reader(root)
    np.save(path_of(dataset, "test_day_1578_0080", "label"), label)
    with pytest.raises(InputError, match=said):
        dataset.read("test_day_1578_0080")


def test_whole_frames_and_crops_that_reach_out(root: Path) -> None:
    name = "seq_00_day_00_1570_0000"
    whole = reader(root, crop=None).read(name)
    assert np.array_equal(whole.rgb, files.contents("1570_0000")[0])
    assert whole.thermal.shape == files.HW
    assert reader(root, crop=(0, 13, 0, 26)).read(name).rgb.shape[:2] == files.HW
    for crop in ((0, 14, 0, 26), (0, 13, 5, 27)):
        with pytest.raises(InputError, match=r"dataset.crop=\[0, 1.* has 13x26 pixels"):
            reader(root, crop=crop).read(name)
    with pytest.raises(InputError, match=r"reaches to row 645 and column 1640, but .* has 13x26"):
        Freiburg(str(root)).read(name)


@pytest.mark.parametrize("hw", [(39, 78), (15, 30), (11, 22)])
def test_label_of_other_size_is_resized(root: Path, hw: tuple[int, int]) -> None:
    dataset = reader(root, crop=None, ignored_test=())
    label = files.contents("label", hw)[2]
    write_png(path_of(dataset, "seq_00_day_00_1570_0000", "label"), label)
    np.save(path_of(dataset, "test_day_1578_0080", "label"), label.astype(np.int16))
    # The middle of pixel x of n is in pixel (x + 0.5) m / n, rounded down, of m.
    rows, columns = (
        np.floor((np.arange(n) + 0.5) * m / n).astype(int)
        for n, m in zip(files.HW, hw, strict=True)
    )
    for name in ("seq_00_day_00_1570_0000", "test_day_1578_0080"):
        assert np.array_equal(dataset.label(name), label[np.ix_(rows, columns)])


@pytest.mark.parametrize("hw", [(26, 13), (13, 24), (11, 26)])
def test_labels_of_another_shape_are_refused(root: Path, hw: tuple[int, int]) -> None:
    dataset = reader(root)
    path = path_of(dataset, "seq_00_day_00_1570_0000", "label")
    write_png(path, np.zeros(hw, np.uint8))
    with pytest.raises(InputError) as caught:
        dataset.read("seq_00_day_00_1570_0000")
    assert str(caught.value) == (
        f"{path} has {hw[0]}x{hw[1]} pixels but its frame 13x26, which is another aspect "
        "ratio; use the label of the whole frame."
    )


@pytest.mark.parametrize(
    ("ignored", "gone"), [(("ignore",), [13]), ((), []), (("background", "ignore"), [12, 13])]
)
def test_ignored_test_applies_to_test_only(
    root: Path, ignored: tuple[str, ...], gone: list[int]
) -> None:
    dataset = reader(root, ignored_test=ignored, crop=None)
    for split, counts in (("train_day", False), ("val", True), ("test", True)):
        for name in dataset.names(split):
            label = files.contents("_".join(name.split("_")[-2:]))[2]
            if counts:
                label[np.isin(label, gone)] = 255
            assert np.array_equal(dataset.label(name), label)


def test_fingerprint(root: Path, tmp_path: Path) -> None:
    expected = reader(root).fingerprint()
    assert len(expected) == 64
    other = write_freiburg(tmp_path / "elsewhere")
    assert reader(other).fingerprint() == expected
    assert reader(other, thermal_range=(21800, 25000)).fingerprint() == expected
    for changed in (
        {"crop": None},
        {"ignored_test": ()},
        {"val_sequences": ("seq_00_day",)},
    ):
        assert reader(other, **changed).fingerprint() != expected
    path_of(reader(other), "test_day_1578_0080", "label").write_bytes(b"shorter")
    assert reader(other).fingerprint() != expected
    path_of(reader(root), "seq_00_night_00_1575_0050", "thermal").unlink()
    assert reader(root).fingerprint() != expected


def test_sequences_that_are_held_out(root: Path, tmp_path: Path) -> None:
    dataset = Freiburg(str(root), crop=files.CROP)
    assert len(dataset.names("train_day")) == len(dataset.names("train")) == 5
    assert "val" not in dataset.splits
    assert not dataset.has("val")
    with pytest.raises(InputError, match="dataset.val_sequences"):
        dataset.names("val")
    assert not check_dataset(dataset).problems
    assert dataset.fingerprint() != reader(root).fingerprint()
    for word in ("seq_40_day", "seq_00_night"):
        with pytest.raises(InputError, match=f"dataset.val_sequences: '{word}' is not a valid"):
            reader(root, val_sequences=(word,)).names("val")
        assert len(reader(root, val_sequences=(word,)).names("test")) == 4  # another archive
    files.write_training(tmp_path, "seq_04_day/00", "1_0")
    for split in ("train_night", "test", "train"):
        assert not reader(tmp_path).has(split)
        with pytest.raises(InputError, match=f"split '{split}' of freiburg is empty"):
            reader(tmp_path).names(split)


def test_folders_in_other_capitals_and_without_a_time(root: Path, tmp_path: Path) -> None:
    for folders in (
        ("ImagesRgb", "ImagesIr", "SegmentationClass"),
        ("imagesrgb", "IMAGESIR", "segmentationclass"),
    ):
        files.write_test(tmp_path / folders[0], "night", "1570_120", folders=folders)
        dataset = reader(tmp_path / folders[0])
        assert dataset.names("test_night") == ("test_night_1570_120",)
        assert dataset.read("test_night_1570_120").label is not None
    files.write_training(root, "seq_05_dusk/00", "1_0")
    with pytest.raises(InputError, match="expected a sequence with day or night in its name"):
        reader(root).names("test")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"crop": (5, 5, 0, 1)}, r"dataset.crop: expected \[first row, row after the last, "),
        ({"crop": (0, 5, 9, 1)}, "dataset.crop: expected"),
        ({"thermal_range": (23700, 21800)}, "dataset.thermal_range: "),
        ({"ignored_test": ("ignored",)}, "dataset.ignored_test: 'ignored' .* mean 'ignore'"),
        ({"unscored": ("void",)}, "dataset.unscored: 'void' is not a valid choice"),
    ],
)
def test_wrong_settings_are_named(root: Path, wrong: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        reader(root, **wrong)


def test_check_reports_files_of_no_frame(root: Path) -> None:
    dataset = reader(root)
    report = check_dataset(dataset)
    assert report.problems == ()
    night = report.splits["train_night"]
    assert (night.read, night.unlabelled, night.day, night.night) == (3, 3, 0, 3)
    assert night.sizes == {(11, 18): 3}
    val = dataset.frame(dataset.names("val")[0])
    val.rgb.unlink()
    assert list(check_dataset(reader(root)).problems) == [
        f"2 files belong to no image of a split; the first is {val.thermal}."
    ]
