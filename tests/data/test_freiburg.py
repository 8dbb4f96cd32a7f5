"""Freiburg Thermal: frames, partners, labels, and what the check finds in a copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.freiburg import Freiburg
from rgbt.data.report import check_dataset
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


@pytest.mark.parametrize("folder", ["seq_05_dusk", "seq_05_day_and_night"])
def test_a_sequence_of_no_time_is_refused(root: Path, folder: str) -> None:
    (root / "train" / folder / "00").mkdir(parents=True)
    with pytest.raises(InputError, match=rf"{folder}: expected the name of a sequence with day"):
        reader(root).names("test")


def test_val_may_be_pieces_of_sequences(root: Path) -> None:
    dataset = reader(root, val_sequences=("seq_00_day/01",))
    assert dataset.names("val") == ("seq_00_day_01_1572_0020",)
    assert len(dataset.names("train_day")) == 4


@pytest.mark.parametrize("split", ["train", "train_day", "val"])
def test_an_unknown_val_sequence_is_named(root: Path, split: str) -> None:
    dataset = reader(root, val_sequences=("seq_40_day",))
    with pytest.raises(InputError, match=r"no day sequence 'seq_40_day' in .*did you mean 'seq_"):
        dataset.names(split)
    assert len(dataset.names("test")) == 4  # which is another archive
    with pytest.raises(InputError, match="no day sequence 'seq_00_night'"):
        reader(root, val_sequences=("seq_00_night",)).names("val")


def test_empty_splits_are_one_sentence(tmp_path: Path) -> None:
    files.write_training(tmp_path, "seq_04_day/00", "1_0")
    dataset = reader(tmp_path)
    for split, said in (
        (
            "train_night",
            r"split 'train_night' of freiburg is empty: expected train/seq_\*_night/.*",
        ),
        ("test", r"split 'test' .* unpack the archive 'test' there\."),
        ("train", r"every day sequence is in dataset.val_sequences; remove one of them\."),
    ):
        assert not dataset.has(split)
        with pytest.raises(InputError, match=said):
            dataset.names(split)
    with pytest.raises(InputError, match="no split 'tran'; did you mean 'train'"):
        dataset.names("tran")


def test_by_default_all_days_are_for_training_and_there_is_no_val(root: Path) -> None:
    dataset = Freiburg(str(root), crop=files.CROP)
    assert len(dataset.names("train_day")) == len(dataset.names("train")) == 5
    assert "val" not in dataset.splits
    assert not dataset.has("val")
    said = (
        r"^freiburg has no validation split, because dataset.val_sequences=\[\]; name day .*\]\.$"
    )
    with pytest.raises(InputError, match=said):
        dataset.names("val")
    assert not check_dataset(dataset).problems
    assert dataset.fingerprint() != reader(root).fingerprint()


@pytest.mark.parametrize("time", ["day", "night"])
def test_stamp_of_thermal_may_lack_last_zero(tmp_path: Path, time: str) -> None:
    files.write_test(tmp_path, time, "1570_120", thermal="1570_12")
    files.write_test(tmp_path, time, "1571_130", thermal="1571_130")
    dataset = reader(tmp_path)
    for name, partner in zip(dataset.names("test"), ("1570_12", "1571_130"), strict=True):
        assert path_of(dataset, name, "thermal").name == f"{partner}_ir.png"
        stamp = name.removeprefix(f"test_{time}_")
        counts = dataset.thermal_values(name)
        assert np.array_equal(counts, files.contents(stamp)[1][1:12, 5:23])
        assert dataset.read(name).label is not None


def test_shared_thermal_image_is_refused(tmp_path: Path) -> None:
    files.write_test(tmp_path, "day", "1570_120", thermal="1570_12")
    files.write_test(tmp_path, "day", "1570_12")
    with pytest.raises(InputError, match=r"would both have .*1570_12_ir.png as their thermal"):
        reader(tmp_path).names("test")


@pytest.mark.parametrize(
    "folders",
    [
        ("ImagesRgb", "ImagesIr", "SegmentationClass"),
        ("imagesrgb", "IMAGESIR", "segmentationclass"),
    ],
)
def test_capitals_of_folders_do_not_count(tmp_path: Path, folders: tuple[str, ...]) -> None:
    files.write_test(tmp_path, "night", "1570_120", folders=folders)
    dataset = reader(tmp_path)
    assert dataset.names("test_night") == ("test_night_1570_120",)
    assert dataset.read("test_night_1570_120").label is not None


def test_what_is_no_frame_is_passed_over(root: Path) -> None:
    expected = reader(root).names("train")
    piece = root / "train/seq_00_day/00"
    for stray in ("fl_rgb/._fl_rgb_1_0.png", "fl_rgb/other.png", "fl_rgb/fl_rgb_1_0.txt"):
        (piece / stray).write_bytes(b"")
    (root / "train/.cache/00").mkdir(parents=True)
    (root / "train/readme.txt").write_text("")
    assert reader(root).names("train") == expected


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
    "image", [np.full(files.HW, 85, np.uint8), np.zeros((*files.HW, 3), np.uint16)]
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
        (np.full(files.HW, 14), "label value 14 .*is out of range; expected 0 to 13, or 255"),
        (np.full(files.HW, -1), "label value -1 .*is out of range"),
        (np.full(files.HW, 256 + 3), "label value 259 .*is out of range"),
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
        with pytest.raises(InputError, match=r"the frame is 13x26 pixels but dataset.crop=\[0, 1"):
            reader(root, crop=crop).read(name)
    with pytest.raises(InputError, match=r"frame is 13x26 .* reaches to row 645 and column 1640."):
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
        "ratio. Use the label of the whole frame."
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


def test_wrong_roots(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dataset.root: the folder '/nowhere' does not exist"):
        Freiburg("/nowhere")
    with pytest.raises(InputError, match="holds neither the folder train nor the folder test"):
        Freiburg(str(tmp_path))


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"crop": (5, 5, 0, 1)}, r"dataset.crop: expected \[first row, row after the last, "),
        ({"crop": (-1, 5, 0, 1)}, "dataset.crop: expected"),
        ({"crop": (0, 5, 9, 1)}, "dataset.crop: expected"),
        ({"thermal_range": (23700, 21800)}, r"dataset.thermal_range: expected counts 0 <= low"),
        ({"thermal_range": (0, 65536)}, r"got \[0, 65536\]"),
        ({"ignored_test": ("ignored",)}, "dataset.ignored_test: 'ignored' .* mean 'ignore'"),
        ({"unscored": ("void",)}, "dataset.unscored: 'void' is not a valid choice"),
        ({"num_classes": 13}, "num_classes is 13 but dataset.classes has 14"),
    ],
)
def test_wrong_settings_are_named(root: Path, wrong: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=said):
        reader(root, **wrong)


def test_check_of_a_sound_copy(root: Path) -> None:
    report = check_dataset(reader(root))
    assert report.problems == ()
    numbers = {
        split.split: (split.num_read, split.num_unlabelled, split.num_day, split.num_night)
        for split in report.splits
    }
    assert numbers == {
        **{"train": (3, 0, 3, 0), "train_day": (3, 0, 3, 0), "train_night": (3, 3, 0, 3)},
        **{"val": (2, 0, 2, 0), "test": (4, 0, 2, 2)},
        **{"test_day": (2, 0, 2, 0), "test_night": (2, 0, 0, 2)},
    }
    assert all(set(split.sizes) == {(11, 18)} for split in report.splits)


def test_pixels_are_counted_by_class(root: Path) -> None:
    report = check_dataset(reader(root))
    for split in report.splits:
        expected = np.zeros(15, int)
        for name in reader(root).names(split.split):
            label = files.contents("_".join(name.split("_")[-2:]))[2][1:12, 5:23].ravel()
            if split.split != "train_night":
                expected[:14] += np.bincount(label, minlength=14)
        if "train" not in split.split:
            expected[[13, 14]] = expected[[14, 13]]
        assert split.pixels.tolist() == expected.tolist()


def test_the_share_of_clipped_counts(root: Path) -> None:
    dataset = reader(root)
    counts = np.full(files.HW, 22000, np.uint16)
    # Inside the crop of 11 x 18 = 198 pixels, of three frames; and one pixel outside of it.
    counts[1, 5:23] = 0
    counts[2, 5:10] = 21799
    counts[3, 5:7] = 23701
    counts[4, 5:9] = (21800, 23700, 23700, 21800)
    counts[0, 0] = 65535
    for name in dataset.names("train_night"):
        write_png(dataset.frame(name).thermal, counts)
    report = check_dataset(dataset)
    (split,) = [each for each in report.splits if each.split == "train_night"]
    assert split.thermal == (3 * 198, 3 * 18, 3 * 5, 3 * 2, 21799, 23701)
    assert (
        "split train_night: 9.09% of the thermal pixels are 0, 2.53% lie below and 1.01% above "
        "dataset.thermal_range=[21800, 23700]; the others range from 21799 to 23701."
        in report.notes
    )
    assert not any("split train:" in note or "split test:" in note for note in report.notes)


def test_a_thermal_image_of_margins_alone(root: Path) -> None:
    dataset = reader(root)
    for name in dataset.names("val"):
        write_png(dataset.frame(name).thermal, np.zeros(files.HW, np.uint16))
    (split,) = [each for each in check_dataset(dataset).splits if each.split == "val"]
    assert split.thermal == (2 * 198, 2 * 198, 0, 0, 0, 0)


def test_check_finds_each_problem_once(root: Path) -> None:
    dataset = reader(root)
    val = dataset.frame(dataset.names("val")[0])
    val.rgb.unlink()
    # A frame of training under the same stamp as one for testing; its thermal lacks the zero.
    files.write_training(root, "seq_00_day/01", "1579_009")
    assert list(check_dataset(reader(root)).problems) == [
        f"2 files belong to no image of a split; the first is {val.thermal}.",
        "splits test_day and train_day share 1 frames by their time stamps; the first is "
        "'test_day_1579_0090', which is 'seq_00_day_01_1579_009'.",
    ]


def test_equal_stamps_in_two_parts_are_reported(root: Path) -> None:
    files.write_training(root, "seq_00_night/01", "1581_0110")
    files.write_training(root, "seq_04_day/01", "1580_0100")
    files.write_training(root, "seq_00_night/01", "1580_01000")  # ten times as many nanoseconds
    found = check_dataset(reader(root)).problems
    assert [problem.partition(" by ")[0] for problem in found] == [
        "splits test_night and train_night share 1 frames",
        "splits test_night and val share 1 frames",
    ]


def test_check_of_a_single_part(tmp_path: Path) -> None:
    files.write_training(tmp_path, "seq_00_day/00", "1_0")
    report = check_dataset(reader(tmp_path, val_sequences=()))
    assert [problem.partition(" of ")[0] for problem in report.problems] == [
        *("split 'train_night'", "split 'test_day'", "split 'test_night'"),
    ]
    assert [note.partition(" of ")[0] for note in report.notes[:1]] == ["split 'test'"]
    assert len(report.splits) == 2
