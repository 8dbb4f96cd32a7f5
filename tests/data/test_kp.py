"""KP: its layout, its splits by lists or by sets, and the images that are picked for it."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt.data.kp import KP, SPLITS, pick_kp
from tests.conftest import write_png
from tests.data.layouts import (
    KP_HW,
    TEST,
    TRAIN,
    VAL,
    kp_image,
    of_kp,
    refused,
    write_jpeg,
    write_kp,
    write_lists,
)

ROOT = Path(__file__).resolve().parents[2]
OFFICIAL = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata" / "kp_names"


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_lists(write_kp(tmp_path / "kp"))


def expected_label(name: str) -> np.ndarray:
    label = of_kp(name)[2]
    assert 19 in label
    return np.where(label == 19, 255, label)


def write_thermal(root: Path, image: np.ndarray) -> None:
    """A PNG, which keeps every level, under the name of a JPEG."""
    path = kp_image(root, TRAIN[0], "lwir")
    write_png(path.with_suffix(".png"), image)
    path.with_suffix(".png").rename(path)


def test_reads_the_layout_of_the_release(root: Path) -> None:
    dataset = KP(str(root))
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in (*TRAIN, *VAL, *TEST):
        sample, (rgb, thermal, _) = dataset.read(name), of_kp(name)
        # Channels in the order of the file, which JPEG changes by two levels at most.
        assert np.abs(sample.rgb.astype(int) - rgb).max() <= 2
        assert np.abs(sample.thermal.astype(int) - thermal).max() <= 1
        np.testing.assert_array_equal(sample.label, expected_label(name))


def test_splits_by_set_number(root: Path) -> None:
    dataset = KP(str(root), lists="sets")
    assert {split: dataset.names(split) for split in dataset.splits} == {
        **{"train": TRAIN, "train_day": TRAIN[:2], "train_night": TRAIN[2:]},
        **{"val": VAL, "val_day": VAL[:1], "val_night": VAL[1:]},
        **{"test": TEST, "test_day": TEST[:2], "test_night": TEST[2:]},
    }
    assert dataset.splits["train_day"] == "labels of the sets [0, 1, 2]"
    nights = dataset.nights(tuple(f"set{number:02d}_V000_I00000" for number in range(12)))
    assert np.flatnonzero(nights).tolist() == [3, 4, 5, 9, 10, 11]


@pytest.mark.parametrize(
    "line", ["00001D", "set12_V000_I00050", "set00_V000_I0050", "set00_V000_I00050.jpg", "../x"]
)
def test_wrong_names_are_refused(root: Path, line: str) -> None:
    (root / "val.txt").write_text(f"{VAL[0]}.png\n{line}\n")
    assert f"'{line}' is not a name such" in refused(lambda: KP(str(root)).names("val"))


@pytest.mark.parametrize(
    ("channels", "grey"),
    [
        ((100, 101, 101), 101),  # 100 2/3
        ((100, 100, 101), 100),  # 100 1/3
        ((96, 104, 100), 100),
        ((255, 255, 254), 255),
        ((0, 0, 8), 3),
        ((0, 8, 0), 3),
    ],
)
def test_thermal_is_the_mean_of_channels(root: Path, channels: tuple[int, ...], grey: int) -> None:
    write_thermal(root, np.full((*KP_HW, 3), channels, np.uint8))
    thermal = KP(str(root)).read(TRAIN[0]).thermal
    assert thermal.shape == KP_HW
    assert (thermal == grey).all()


def test_thermal_of_one_channel_and_in_colours(root: Path) -> None:
    level = of_kp(TRAIN[0])[1]
    write_jpeg(kp_image(root, TRAIN[0], "lwir"), level[..., None])
    assert np.abs(KP(str(root)).read(TRAIN[0]).thermal.astype(int) - level).max() <= 1
    image = np.full((*KP_HW, 3), 100, np.uint8)
    image[3, 5] = (91, 100, 100)  # one pixel, nine levels apart
    write_thermal(root, image)
    said = refused(lambda: KP(str(root)).read(TRAIN[0]))
    assert "within 8 levels" in said
    assert "differ by up to 9" in said


def test_void_is_ignored_and_nothing_else(root: Path) -> None:
    path = root / "labels" / f"{TRAIN[0]}.png"
    label = np.zeros(KP_HW, np.uint8)
    label[0, :3] = (18, 19, 255)
    write_png(path, label)
    assert KP(str(root)).label(TRAIN[0])[0, :4].tolist() == [18, 255, 255, 0]
    label[0, 3] = 20
    write_png(path, label)
    assert "label value 20 " in refused(lambda: KP(str(root)).label(TRAIN[0]))


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
    sizes = [len(listed.names(split)) for split in SPLITS]
    assert sizes == [499, 261, 238, 140, 64, 76, 311, 178, 133]
    assert all(by_set.names(split) == listed.names(split) for split in SPLITS)


def test_lists_are_read_if_there_are_any(root: Path, tmp_path: Path) -> None:
    assert not KP(str(root)).by_set
    (root / "train.txt").write_text(f"{TRAIN[1]}\n")
    assert KP(str(root)).names("train") == TRAIN[1:2]
    assert KP(str(root), lists="sets").names("train") == TRAIN
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").unlink()
    assert KP(str(root)).by_set
    said = refused(lambda: KP(str(root), splits={"train": "mine.txt"}).names("train"))
    assert "split 'train' of kp is empty: expected mine.txt" in said
    dataset = KP(str(write_kp(tmp_path / "days", TRAIN)))
    assert [dataset.has(split) for split in ("train", "val", "train_night")] == [True, False, True]
    assert "labels of the sets [6, 10] in" in refused(lambda: dataset.names("val"))


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
    kp_image(root, TRAIN[0], "lwir").unlink()
    said = refused(lambda: pick_kp(kaist, labels, tmp_path / "again"))
    assert "expected 1 files, such as" in said
    assert "expected labels in" in refused(lambda: pick_kp(kaist, kaist, tmp_path / "again"))
