"""KP: its layout, its splits by lists or by sets, and the images that are picked for it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.kp import KP, SPLITS, is_night, pick_kp
from tests.conftest import write_png
from tests.data.kp_files import (
    HW,
    NAMES,
    TEST,
    TRAIN,
    VAL,
    contents,
    image_path,
    write_jpeg,
    write_kp,
    write_lists,
)

ROOT = Path(__file__).resolve().parents[2]
OFFICIAL = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata" / "kp_names"


DAYS = {"train": TRAIN[:2], "val": VAL[:1], "test": TEST[:2]}
NIGHTS_OF = {"train": TRAIN[2:], "val": VAL[1:], "test": TEST[2:]}


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


def test_splits_by_set_number(root: Path) -> None:
    dataset = KP(str(root), lists="sets")
    assert {split: dataset.names(split) for split in dataset.splits} == {
        **{"train": TRAIN, "train_day": TRAIN[:2], "train_night": TRAIN[2:]},
        **{"val": VAL, "val_day": VAL[:1], "val_night": VAL[1:]},
        **{"test": TEST, "test_day": TEST[:2], "test_night": TEST[2:]},
    }
    assert dataset.splits["train_day"] == "labels of the sets [0, 1, 2]"
    assert dataset.splits["val_night"] == "labels of the sets [10]"
    nights = [number for number in range(12) if is_night(f"set{number:02d}_V000_I00000")]
    assert nights == [3, 4, 5, 9, 10, 11]


@pytest.mark.parametrize(
    "line",
    ["00001D", "set12_V000_I00050", "set00_V000_I0050", "set00_V000_I00050.jpg", "../x"],
)
def test_wrong_names_are_refused(root: Path, line: str) -> None:
    (root / "val.txt").write_text(f"{VAL[0]}.png\n{line}\n")
    with pytest.raises(InputError, match=f"'{line}' is not a name such"):
        KP(str(root)).names("val")
    with pytest.raises(InputError, match="is not a name such as set00_V000_I00050"):
        KP(str(root)).nights((line,))


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
    with pytest.raises(InputError, match=r"lwir/I00050.jpg: .*within 8 levels.*, .* up to 9"):
        KP(str(root)).read(TRAIN[0])


def test_void_is_ignored_and_nothing_else(root: Path) -> None:
    path = root / "labels" / f"{TRAIN[0]}.png"
    label = np.zeros(HW, np.uint8)
    label[0, :3] = (18, 19, 255)
    write_png(path, label)
    assert KP(str(root)).label(TRAIN[0])[0, :4].tolist() == [18, 255, 255, 0]
    label[0, 3] = 20
    write_png(path, label)
    with pytest.raises(InputError, match=r"labels/\S+: label value 20 "):
        KP(str(root)).label(TRAIN[0])
    write_png(path, np.full(HW, 19, np.uint8))
    assert (KP(str(root)).read(TRAIN[0]).label == 255).all()


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


def test_lists_are_read_if_there_are_any(root: Path, tmp_path: Path) -> None:
    assert not KP(str(root)).by_set
    (root / "train.txt").write_text(f"{TRAIN[1]}\n")
    assert KP(str(root)).names("train") == TRAIN[1:2]
    assert KP(str(root), lists="sets").names("train") == TRAIN
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").unlink()
    assert KP(str(root)).by_set
    with pytest.raises(InputError, match="split 'train' of kp is empty: expected mine.txt"):
        KP(str(root), splits={"train": "mine.txt"}).names("train")
    dataset = KP(str(write_kp(tmp_path / "days", TRAIN)))
    assert [dataset.has(split) for split in ("train", "val", "train_night")] == [True, False, True]
    with pytest.raises(
        InputError, match=r"'val' of kp is empty: .* labels of the sets \[6, 10\] in"
    ):
        dataset.names("val")


def test_images_of_hand_drawn_labels_are_picked(root: Path, tmp_path: Path) -> None:
    kaist, labels, out = root / "images", tmp_path / "labels", tmp_path / "out"
    for folder, name in (("val_day", TRAIN[0]), ("val_night", TRAIN[2]), ("train_day", TRAIN[1])):
        (labels / folder).mkdir(parents=True)
        shutil.copy(root / "labels" / f"{name}.png", labels / folder)
    assert pick_kp(kaist, labels, out) == 2
    picked = KP(str(out))
    assert picked.names("train") == (TRAIN[0], TRAIN[2])
    for name in picked.names("train"):
        np.testing.assert_array_equal(picked.read(name).thermal, KP(str(root)).read(name).thermal)
        np.testing.assert_array_equal(picked.read(name).label, expected_label(name))
    image_path(root, TRAIN[0], "lwir").unlink()
    with pytest.raises(InputError, match=r"expected 1 files, such as .*lwir/I00050.jpg"):
        pick_kp(kaist, labels, tmp_path / "again")
    with pytest.raises(InputError, match="expected labels in"):
        pick_kp(kaist, kaist, tmp_path / "again")


def test_splits_by_list_and_by_set_have_one_fingerprint(root: Path) -> None:
    write_lists(root, {f"{split}_day": day for split, day in DAYS.items()})
    write_lists(root, {f"{split}_night": night for split, night in NIGHTS_OF.items()}, "")
    dataset = KP(str(root))
    assert dataset.names("test_night") == TEST[2:]
    expected = dataset.fingerprint()
    assert KP(str(root), lists="sets").fingerprint() == expected
    write_lists(root, {"test": TEST[1:]})
    assert KP(str(root)).fingerprint() != expected
