"""KP: its layouts, who divides it into splits, and what the check finds in a copy."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.kp import KP
from rgbt.data.kp_layout import SPLITS, is_night
from rgbt.data.report import check_dataset
from tests.conftest import write_png
from tests.data.kp_files import (
    HW,
    NAMES,
    NIGHTS,
    TEST,
    TRAIN,
    VAL,
    contents,
    image_path,
    write_jpeg,
    write_kp,
    write_lists,
    write_ms_uda,
)

ROOT = Path(__file__).resolve().parents[2]
OFFICIAL = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata" / "kp_names"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_lists(write_kp(tmp_path / "kp"))


def expected_label(name: str) -> np.ndarray:
    label = contents(name)[2]
    assert 19 in label
    return np.where(label == 19, 255, label)


def write_exact(path: Path, image: np.ndarray) -> None:
    """A PNG, which keeps every level, under a name that ends in .jpg."""
    write_png(path.with_suffix(".png"), image)
    path.with_suffix(".png").rename(path)


def test_reads_the_layout_of_the_release(root: Path) -> None:
    dataset = KP(str(root))
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in NAMES:
        sample = dataset.read(name)
        rgb, thermal, _ = contents(name)
        assert [sample.rgb.dtype, sample.thermal.dtype, sample.name] == [np.uint8, np.uint8, name]
        # Channels in the order of the file, which JPEG changes by two levels at most.
        assert np.abs(sample.rgb.astype(int) - rgb).max() <= 2
        assert np.abs(sample.thermal.astype(int) - thermal).max() <= 1
        np.testing.assert_array_equal(sample.label, expected_label(name))
    assert dataset.files(TEST[3]) == (
        root / "images/set11/V001/visible/I01512.jpg",
        root / "images/set11/V001/lwir/I01512.jpg",
        root / "labels/set11_V001_I01512.png",
    )


def test_reads_the_layout_of_ms_uda(tmp_path: Path) -> None:
    root = write_ms_uda(tmp_path)
    dataset = KP(str(root))
    assert dataset.lists == "sets"
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in (TRAIN[0], TRAIN[2]):
        sample = dataset.read(name)
        np.testing.assert_array_equal(sample.rgb, contents(name)[0])
        np.testing.assert_array_equal(sample.thermal, contents(name)[1])
        np.testing.assert_array_equal(sample.label, expected_label(name))
    assert dataset.files(TRAIN[2]) == (
        tmp_path / "pseudo_KP/val_night/set03_V001_visible_I00117.png",
        tmp_path / "pseudo_KP/val_night/set03_V001_lwir_I00117.png",
        tmp_path / "labels/val_night/set03_V001_I00117.png",
    )
    report = check_dataset(dataset)
    assert report.problems == ()
    assert report.notes[0].startswith("no list is used: all labels on disk are divided")
    assert dataset.title == "KP in the layout of MS-UDA, splits from set numbers"
    (root / "val_day_rgb.txt").write_text("set00_V000_visible_I00050.png\n")
    (root / "val_night_th.txt").write_text("set09_V000_lwir_I00184.png\n")
    dataset = KP(str(root), splits={"train": "val_day_rgb.txt", "val": "val_night_th.txt"})
    assert dataset.lists == "files"
    assert (dataset.names("train"), dataset.names("val")) == (TRAIN[:1], (TEST[2],))


def test_labels_of_ms_uda_with_images_of_release(root: Path) -> None:
    for name in NAMES:
        time = "val_night" if name[:5] in NIGHTS else "val_day"
        target = root / "labels" / time / f"{name}.png"
        target.parent.mkdir(exist_ok=True)
        (root / "labels" / f"{name}.png").rename(target)
    dataset = KP(str(root), lists="sets")
    assert dataset.names("test") == TEST
    np.testing.assert_array_equal(dataset.read(VAL[1]).label, expected_label(VAL[1]))


def test_splits_by_set_number(root: Path) -> None:
    dataset = KP(str(root), lists="sets")
    assert {split: dataset.names(split) for split in dataset.splits} == {
        **{"train": TRAIN, "train_day": TRAIN[:2], "train_night": TRAIN[2:]},
        **{"val": VAL, "val_day": VAL[:1], "val_night": VAL[1:]},
        **{"test": TEST, "test_day": TEST[:2], "test_night": TEST[2:]},
    }
    assert dataset.splits["train_day"] == "labels of set00, set01, set02"
    assert dataset.splits["val_night"] == "labels of set10"
    nights = [number for number in range(12) if is_night(f"set{number:02d}_V000_I00000")]
    assert nights == [3, 4, 5, 9, 10, 11]


def test_source_of_the_splits(root: Path) -> None:
    assert KP(str(root)).lists == "files"
    (root / "train.txt").write_text(f"{TRAIN[1]}\n")
    assert KP(str(root)).names("train") == TRAIN[1:2]
    assert KP(str(root), lists="sets").names("train") == TRAIN
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").unlink()
    assert KP(str(root)).lists == "sets"
    assert KP(str(root), lists="files").lists == "files"
    with pytest.raises(
        InputError, match=r"dataset.splits.train: the list '\S+mine.txt' does not exist"
    ):
        KP(str(root), splits={"train": "mine.txt"}).names("train")
    with pytest.raises(
        InputError, match=r"splits names lists, but dataset.lists=sets does not use lists"
    ):
        KP(str(root), splits={"train": "mine.txt"}, lists="sets")


def test_day_and_night_of_one_list(root: Path) -> None:
    dataset = KP(str(root))
    assert dataset.names("train_day") == TRAIN[:2]
    assert dataset.names("test_night") == TEST[2:]
    write_lists(root, {"train_day": TRAIN[1:2], "val": VAL[:1]})
    dataset = KP(str(root))
    assert dataset.names("train_day") == TRAIN[1:2]  # its own list comes first
    assert dataset.has("val_day")
    assert not dataset.has("val_night")
    with pytest.raises(InputError, match=r"'val_night' of kp is empty: .* image in '\S+val.txt'"):
        dataset.names("val_night")
    assert len(dataset.fingerprint()) == 64


def test_split_is_union_of_day_and_night(tmp_path: Path) -> None:
    root = write_kp(tmp_path)
    write_lists(root, {"test_day": TEST[1::-1], "test_night": TEST[2:], "train_day": TRAIN[:1]}, "")
    dataset = KP(str(root))
    assert dataset.names("test") == TEST  # sorted
    assert dataset.names("test_day") == TEST[1::-1]  # as listed
    assert not dataset.has("train")
    with pytest.raises(InputError, match=r"the list '\S+/train.txt' does not exist; .*lists=sets"):
        dataset.names("train")


@pytest.mark.parametrize(
    "line",
    ["00001D", "set12_V000_I00050", "set00_V000_I0050", "set00_V000_I00050.jpg", "../x"],
)
def test_wrong_names_are_refused(root: Path, line: str) -> None:
    (root / "val.txt").write_text(f"{VAL[0]}.png\n{line}\n")
    with pytest.raises(InputError, match=rf"splits.val: '{line}' in '\S+' is not a name such"):
        KP(str(root)).names("val")
    with pytest.raises(InputError, match="is not a name such as set00_V000_I00050"):
        KP(str(root)).nights((line,))


def test_sets_without_labels(tmp_path: Path) -> None:
    dataset = KP(str(write_kp(tmp_path, TRAIN)))
    assert [dataset.has(split) for split in ("train", "val", "train_night")] == [True, False, True]
    with pytest.raises(InputError, match=r"'val' of kp is empty: .* labels of set06, set10 in"):
        dataset.names("val")
    assert len(dataset.fingerprint()) == 64


@pytest.mark.parametrize(
    ("channels", "grey"),
    [
        ((100, 100, 100), 100),
        ((100, 101, 101), 101),  # 100 2/3
        ((100, 100, 101), 100),  # 100 1/3
        ((96, 104, 100), 100),
        ((255, 255, 254), 255),
        ((0, 0, 8), 3),
        ((0, 8, 0), 3),
    ],
)
def test_thermal_is_the_mean_of_channels(root: Path, channels: tuple[int, ...], grey: int) -> None:
    write_exact(image_path(root, TRAIN[0], "lwir"), np.full((*HW, 3), channels, np.uint8))
    thermal = KP(str(root)).read(TRAIN[0]).thermal
    assert thermal.shape == HW
    assert (thermal == grey).all()


def test_thermal_of_one_channel_and_in_colours(root: Path) -> None:
    path = image_path(root, TRAIN[0], "lwir")
    write_jpeg(path, contents(TRAIN[0])[1][..., None])
    grey = KP(str(root)).read(TRAIN[0]).thermal
    assert np.abs(grey.astype(int) - contents(TRAIN[0])[1]).max() <= 1
    image = np.full((*HW, 3), 100, np.uint8)
    image[3, 5] = (91, 100, 100)  # one pixel, nine levels apart
    write_exact(path, image)
    with pytest.raises(InputError, match=r"lwir/I00050.jpg: .* within 8 levels, .* up to 9 levels"):
        KP(str(root)).read(TRAIN[0])


def test_void_is_ignored_and_nothing_else(root: Path) -> None:
    path = root / "labels" / f"{TRAIN[0]}.png"
    label = np.zeros(HW, np.uint8)
    label[0, :3] = (18, 19, 255)
    write_png(path, label)
    assert KP(str(root)).label(TRAIN[0])[0, :4].tolist() == [18, 255, 255, 0]
    label[0, 3] = 20
    write_png(path, label)
    with pytest.raises(InputError, match=r"labels/\S+: label value 20 .*is out of range"):
        KP(str(root)).label(TRAIN[0])
    write_png(path, np.full(HW, 19, np.uint8))
    assert (KP(str(root)).read(TRAIN[0]).label == 255).all()


def test_fingerprint_is_of_names_and_not_of_lists(root: Path) -> None:
    expected = KP(str(root)).fingerprint()
    assert KP(str(root), lists="sets").fingerprint() == expected  # the same names
    write_lists(root, ending="")
    assert KP(str(root)).fingerprint() == expected
    write_lists(root, {"test": TEST[1:]})
    assert KP(str(root)).fingerprint() != expected


def test_wrong_roots_are_refused(root: Path, tmp_path: Path) -> None:
    for wrong in (tmp_path, root / "images"):
        with pytest.raises(InputError, match=rf"does not hold the folders images .* give {root}\."):
            KP(str(wrong))
    (tmp_path / "empty" / "deep").mkdir(parents=True)
    with pytest.raises(InputError, match="give the folder that does"):
        KP(str(tmp_path / "empty" / "deep"))


@pytest.mark.skipif(not OFFICIAL.exists(), reason="reference material is not here")
def test_official_lists_are_those_by_set_number(tmp_path: Path) -> None:
    for folder in ("images", "labels"):
        (tmp_path / folder).mkdir()
    for path in OFFICIAL.glob("*.txt"):
        (tmp_path / path.name).write_text(path.read_text())
    listed = KP(str(tmp_path))
    for split in ("train", "val", "test"):
        for name in listed.names(split):
            (tmp_path / "labels" / f"{name}.png").touch()
    by_set = KP(str(tmp_path), lists="sets")
    assert {split: len(listed.names(split)) for split in SPLITS} == {
        **{"train": 499, "train_day": 261, "train_night": 238},
        **{"val": 140, "val_day": 64, "val_night": 76},
        **{"test": 311, "test_day": 178, "test_night": 133},
    }
    for split in SPLITS:
        assert by_set.names(split) == listed.names(split)


def test_check_of_a_sound_copy(root: Path) -> None:
    dataset = KP(str(root))
    report = check_dataset(dataset)
    assert report.problems == ()
    times = {
        split.split: (split.num_read, split.num_day, split.num_night) for split in report.splits
    }
    assert times == {
        **{"train": (3, 2, 1), "train_day": (2, 2, 0), "train_night": (1, 0, 1)},
        **{"val": (2, 1, 1), "val_day": (1, 1, 0), "val_night": (1, 0, 1)},
        **{"test": (4, 2, 2), "test_day": (2, 2, 0), "test_night": (2, 0, 2)},
    }
    assert report.notes[0] == "splits are read from the lists train.txt, val.txt, test.txt."
    assert (
        "split train has 2 day and 1 night images, but the official list has 261 and 238 (499 in "
        "total)." in report.notes
    )
    assert len(report.notes) == 5
    assert report.notes[-1].startswith("images are 16x24, but the original images are 512x640")
    assert dataset.title == "KP in the layout of the CRM release, splits from list files"
    assert len(check_dataset(KP(str(root), name="own")).notes) == 1


def test_check_notes_the_division_of_ms_uda(root: Path) -> None:
    days = [name for name in NAMES if name[:5] in ("set00", "set02", "set06", "set07", "set08")]
    nights = [name for name in NAMES if name not in days]
    for lists, expected in (
        ({}, False),
        ({"train": days, "val": nights, "test": nights}, True),
        # A day of CRM to train on and one of its nights to validate on is no division of MS-UDA.
        ({"train": TRAIN[:2], "val": VAL[1:]}, False),
        ({"train": [*days, TRAIN[2]], "val": VAL[1:]}, False),
    ):
        write_lists(root, lists)
        notes = check_dataset(KP(str(root))).notes
        assert any("as in MS-UDA" in note for note in notes) == expected


def test_check_finds_each_problem_once(root: Path) -> None:
    lists = {
        **{"train": TRAIN, "train_day": [TRAIN[0], TRAIN[2]], "train_night": TRAIN[2:]},
        **{"val": (*VAL, VAL[0]), "test": (*TEST[:3], TRAIN[1])},
    }
    write_lists(root, lists)
    write_png(root / "labels" / "00001D.png", np.zeros(HW, np.uint8))
    found = check_dataset(KP(str(root))).problems
    for text in (
        f"split val lists '{VAL[0]}' 2 times.",
        f"split val_day lists '{VAL[0]}' 2 times.",
        f"splits train and test share 1 names; the first is '{TRAIN[1]}'.",
        f"splits train_day and train_night share 1 names; the first is '{TRAIN[2]}'.",
        f"split train_day lists '{TRAIN[2]}', which is a night image.",
        "split train is not the union of train_day and train_night: 1 names are missing on one "
        f"side; the first is '{TRAIN[1]}'.",
        "1 labels have names without a set; the first is '00001D.png'.",
        f"1 files belong to no image of a split; the first is {root}/labels/{TEST[3]}.png.",
        f"splits train and test_day share 1 names; the first is '{TRAIN[1]}'.",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 9


def test_check_of_missing_and_shared_lists(root: Path) -> None:
    (root / "test.txt").unlink()
    report = check_dataset(KP(str(root)))
    assert len(report.problems) == 2
    assert report.problems[0].startswith("dataset.splits.test: the list")
    assert report.problems[1].startswith("4 files belong to no image of a split")
    splits = {"train": "train.txt", "val": "val.txt", "val_day": "val_day.txt", "test": "val.txt"}
    report = check_dataset(KP(str(root), splits=splits))
    assert len(report.problems) == 1
    assert report.notes[0] == "splits are read from the lists train.txt, val.txt."
