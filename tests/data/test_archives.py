"""MFNet with second frames, KP and PST900: their layouts, lists and parts."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from rgbt.data.kp import KP, SPLITS, pick_kp
from rgbt.data.mfnet import MFNet, NextFrames
from rgbt.data.pst900 import PST900, bag_of
from tests.conftest import write_data, write_png
from tests.data.layouts import (
    BAGS,
    BAGS_TEST,
    KP_HW,
    TEST,
    TRAIN,
    VAL,
    kp_image,
    of_kp,
    of_pst900,
    refused,
    write_jpeg,
    write_kp,
    write_lists,
    write_pst900,
    write_triple,
)

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"


@pytest.mark.parametrize("layout", ["packed", "folders"])
def test_reads_both_layouts_in_rgb_order(write_mfnet, expected_pair, layout: str) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip"]}, layout=layout)
    dataset = MFNet(str(root))
    assert dataset.layout == layout
    for name in dataset.names("train"):  # mirrored copies are read as they are
        sample = dataset.read(name)
        arrays = (sample.rgb, sample.thermal, sample.label)
        for found, expected in zip(arrays, expected_pair(name, (24, 32)), strict=True):
            assert found.dtype == np.uint8
            np.testing.assert_array_equal(found, expected)
    (other,) = {"packed", "folders"} - {layout}
    assert "does not hold the folders " in refused(lambda: MFNet(str(root), layout=other))
    write_mfnet({"train": ["00001D"]}, layout=other)
    assert MFNet(str(root), layout=layout).layout == layout
    assert MFNet(str(root)).layout == "packed"


def test_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00003N", "00001D"]})
    (root / "train.txt").write_text("00003N\r\n\n 00001D \r\n")
    dataset = MFNet(str(root), splits={"train": "train.txt", "val": "train.txt", "test": "no.txt"})
    assert dataset.names("train") == dataset.names("val") == ("00003N", "00001D")
    assert not dataset.has("test")
    said = refused(lambda: dataset.names("test"))
    assert "split 'test' of mfnet is empty: expected no.txt" in said


def test_day_or_night_of_a_split_needs_no_list(write_mfnet) -> None:
    train = ["00003N", "00001D", "00002N_flip"]
    root = write_mfnet({"train": train, "test": ["00001D"], "test_day": ["00004D"]})
    dataset = MFNet(str(root))
    before = dataset.fingerprint()
    assert dataset.names("train_night") == ("00003N", "00002N_flip")
    assert dataset.names("train_day") == ("00001D",)
    assert dataset.names("test_day") == ("00004D",), "its own list, not that of the test split"
    assert dataset.fingerprint() == before
    for split in ("train_dusk", "train_day_night", "trial_day"):
        assert f"no split '{split}'" in refused(lambda split=split: dataset.names(split))
    assert "split 'val_day' of mfnet is empty" in refused(lambda: dataset.names("val_day"))


def test_day_and_night(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    names = ("00001D", "00001N", "00001D_flip", "00001N_flip")
    assert dataset.nights(names) == (False, True, False, True)
    assert dataset.nights(("frame7",)) is None
    assert "'frame7'" in refused(lambda: dataset.nights((*names, "frame7")))


def test_wrong_channels_and_bits_are_refused(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    rgb, thermal, label = expected_pair("00001D", (24, 32))
    packed = np.dstack([rgb, thermal])
    wrong = label.copy()
    wrong[3, 4] = 9
    for folder, image, said in (
        ("images", rgb, "got 3; use the original file"),
        ("images", packed.astype(np.uint16), "RGBA images of 16 bits per channel are not read"),
        ("labels", label.astype(np.uint16), "expected 8 bits"),
        ("labels", rgb, "got PNG of mode RGB"),
        ("labels", wrong, "label value 9 (1 pixels"),
    ):
        write_mfnet({"train": ["00001D"]})
        png(root / folder / "00001D.png", image)
        told = refused(lambda: MFNet(str(root)).read("00001D"))
        assert f"{folder}/00001D.png: " in told
        assert said in told


# Second frames.

HW = (6, 8)
NAMES = ("00001D", "00002N")
STILL = np.zeros((*HW, 2), np.float32)


@pytest.fixture
def moments(tmp_path: Path) -> Path:
    """Two frames; the second moment of the first one has no motion."""
    for folder in (tmp_path / "mf", tmp_path / "mf" / "next"):
        write_data(folder, {"test": list(NAMES)}, HW)
    (tmp_path / "mf" / "next" / "flow").mkdir()
    np.save(tmp_path / "mf" / "next" / "flow" / NAMES[0], STILL)
    return tmp_path / "mf"


def second(root: Path) -> NextFrames:
    return NextFrames(MFNet(str(root), name="mf", splits={"test": "test.txt"}))


def test_second_frames_are_read_like_first(moments: Path) -> None:
    after = second(moments)
    assert after.dataset.root == moments / "next"
    assert after.dataset.names("test") == NAMES
    assert after.dataset.read(NAMES[0]).label.shape == HW
    for found, expected in zip(after.source(NAMES[0], HW), np.mgrid[:6, :8], strict=True):
        assert found.dtype == np.int64
        assert np.array_equal(found, expected)


def test_flow_is_rows_columns_to_nearest_pixel(moments: Path) -> None:
    flow = STILL.copy()
    flow[2, 3] = (1.4, -2.6)  # (3.4, 0.4): row 3, column 0
    flow[5, 7] = (0.4, 0.4)
    flow[0, 0] = np.nan  # hidden
    flow[0, 1] = (np.nan, 0)
    flow[0, 2] = (0, np.inf)
    np.save(moments / "next" / "flow" / NAMES[0], flow)
    rows, columns = second(moments).source(NAMES[0], HW)
    assert (rows[2, 3], columns[2, 3]) == (3, 0)
    assert (rows[5, 7], columns[5, 7]) == (5, 7)
    assert rows[0, :3].tolist() == columns[0, :3].tolist() == [-1] * 3
    assert (rows == -1).sum() == 3


@pytest.mark.parametrize(
    ("flow", "said"),
    [
        (STILL[:, :7], "shape (6, 8, 2) (rows, columns) like its frame, got float32 of shape (6,"),
        (STILL - (1, 0), "points outside the first frame of 6x8"),
        (STILL + (0.6, 0), "points outside the first frame"),
        (np.array([{}], object), "cannot be read"),
        (np.full((*HW, 2), "far"), "expected real numbers"),
        (None, "is missing"),
    ],
)
def test_invalid_flow_is_refused(moments: Path, flow: np.ndarray | None, said: str) -> None:
    path = moments / "next" / "flow" / f"{NAMES[0]}.npy"
    path.unlink()
    if flow is not None:
        np.save(path, flow)
    told = refused(lambda: second(moments).source(NAMES[0], HW))
    assert said in told
    assert path.name in told
    alone = refused(lambda: NextFrames(second(moments).dataset))
    assert "has no second frames: expected MFNet's layout" in alone


# KP.

OFFICIAL = SHARED / "kp_names"


@pytest.fixture
def kp_root(tmp_path: Path) -> Path:
    return write_lists(write_kp(tmp_path / "kp"))


def expected_label(name: str) -> np.ndarray:
    label = of_kp(name)[2]
    assert 19 in label
    return np.where(label == 19, 255, label)


def write_thermal(kp_root: Path, image: np.ndarray) -> None:
    """A PNG, which keeps every level, under the name of a JPEG."""
    path = kp_image(kp_root, TRAIN[0], "lwir")
    write_png(path.with_suffix(".png"), image)
    path.with_suffix(".png").rename(path)


def test_reads_the_layout_of_the_release(kp_root: Path) -> None:
    dataset = KP(str(kp_root))
    assert [dataset.names(split) for split in ("train", "val", "test")] == [TRAIN, VAL, TEST]
    for name in (*TRAIN, *VAL, *TEST):
        sample, (rgb, thermal, _) = dataset.read(name), of_kp(name)
        # Channels in the order of the file, which JPEG changes by two levels at most.
        assert np.abs(sample.rgb.astype(int) - rgb).max() <= 2
        assert np.abs(sample.thermal.astype(int) - thermal).max() <= 1
        np.testing.assert_array_equal(sample.label, expected_label(name))


def test_splits_by_set_number(kp_root: Path) -> None:
    dataset = KP(str(kp_root), lists="sets")
    assert {split: dataset.names(split) for split in dataset.splits} == {
        "train": TRAIN,
        "train_day": TRAIN[:2],
        "train_night": TRAIN[2:],
        "val": VAL,
        "val_day": VAL[:1],
        "val_night": VAL[1:],
        "test": TEST,
        "test_day": TEST[:2],
        "test_night": TEST[2:],
    }
    assert dataset.splits["train_day"] == "labels of the sets [0, 1, 2]"
    nights = dataset.nights(tuple(f"set{number:02d}_V000_I00000" for number in range(12)))
    assert np.flatnonzero(nights).tolist() == [3, 4, 5, 9, 10, 11]
    for line in ("set12_V000_I00050", "set00_V000_I00050.jpg", "../x"):
        (kp_root / "val.txt").write_text(f"{VAL[0]}.png\n{line}\n")
        assert f"'{line}' is not a name such" in refused(lambda: KP(str(kp_root)).names("val"))


@pytest.mark.parametrize(
    ("channels", "grey"),
    [
        ((100, 101, 101), 101),  # 100 2/3
        ((100, 100, 101), 100),  # 100 1/3
        ((96, 104, 100), 100),
        ((0, 0, 8), 3),
    ],
)
def test_thermal_is_the_mean_of_channels(
    kp_root: Path, channels: tuple[int, ...], grey: int
) -> None:
    write_thermal(kp_root, np.full((*KP_HW, 3), channels, np.uint8))
    thermal = KP(str(kp_root)).read(TRAIN[0]).thermal
    assert thermal.shape == KP_HW
    assert (thermal == grey).all()


def test_thermal_of_one_channel_and_in_colours(kp_root: Path) -> None:
    level = of_kp(TRAIN[0])[1]
    write_jpeg(kp_image(kp_root, TRAIN[0], "lwir"), level[..., None])
    assert np.abs(KP(str(kp_root)).read(TRAIN[0]).thermal.astype(int) - level).max() <= 1
    image = np.full((*KP_HW, 3), 100, np.uint8)
    image[3, 5] = (91, 100, 100)  # one pixel, nine levels apart
    write_thermal(kp_root, image)
    said = refused(lambda: KP(str(kp_root)).read(TRAIN[0]))
    assert "within 8 levels" in said
    assert "differ by up to 9" in said


def test_void_is_ignored_and_nothing_else(kp_root: Path) -> None:
    path = kp_root / "labels" / f"{TRAIN[0]}.png"
    label = np.zeros(KP_HW, np.uint8)
    label[0, :3] = (18, 19, 255)
    write_png(path, label)
    assert KP(str(kp_root)).label(TRAIN[0])[0, :4].tolist() == [18, 255, 255, 0]
    label[0, 3] = 20
    write_png(path, label)
    assert "label value 20 " in refused(lambda: KP(str(kp_root)).label(TRAIN[0]))


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


def test_lists_are_read_if_there_are_any(kp_root: Path) -> None:
    assert not KP(str(kp_root)).by_set
    for split in ("train", "val", "test"):
        (kp_root / f"{split}.txt").unlink()
    assert KP(str(kp_root)).by_set
    said = refused(lambda: KP(str(kp_root), splits={"train": "mine.txt"}).names("train"))
    assert "split 'train' of kp is empty: expected mine.txt" in said
    for name in VAL:
        (kp_root / "labels" / f"{name}.png").unlink()
    assert "labels of the sets [6, 10] in" in refused(lambda: KP(str(kp_root)).names("val"))


def test_images_of_hand_drawn_labels_are_picked(kp_root: Path, tmp_path: Path) -> None:
    kaist, labels, out = kp_root / "images", tmp_path / "labels", tmp_path / "out"
    for folder, name in (("val_day", TRAIN[0]), ("val_night", TRAIN[2]), ("train_day", TRAIN[1])):
        (labels / folder).mkdir(parents=True)
        shutil.copy(kp_root / "labels" / f"{name}.png", labels / folder)
    assert pick_kp(kaist, labels, out) == 2
    picked = KP(str(out))
    assert picked.names("train") == (TRAIN[0], TRAIN[2])
    for name in picked.names("train"):
        np.testing.assert_array_equal(
            picked.read(name).thermal, KP(str(kp_root)).read(name).thermal
        )
        np.testing.assert_array_equal(picked.read(name).label, expected_label(name))
    kp_image(kp_root, TRAIN[0], "lwir").unlink()
    said = refused(lambda: pick_kp(kaist, labels, tmp_path / "again"))
    assert "expected 1 files, such as" in said
    assert "expected labels in" in refused(lambda: pick_kp(kaist, kaist, tmp_path / "again"))


# PST900.


@pytest.fixture
def pst_root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


def test_reads_the_archive(pst_root: Path) -> None:
    (pst_root / "train/rgb" / f"._{BAGS[0]}.png").write_bytes(b"")  # of an archiver
    dataset = PST900(str(pst_root))
    assert dataset.names("train") == tuple(sorted(BAGS))
    assert dataset.names("val") == dataset.names("test") == tuple(sorted(BAGS_TEST))
    for name in (*BAGS, *BAGS_TEST):
        sample = dataset.read(name)
        arrays = (sample.rgb, sample.thermal, sample.label)
        for found, expected in zip(arrays, of_pst900(name), strict=True):
            np.testing.assert_array_equal(found, expected)
    assert dataset.splits["val"] == "test/rgb/*.png"
    assert dataset.nights(dataset.names("train")) is None
    assert "neither train nor test has an image called 'x'" in refused(lambda: dataset.read("x"))


def test_bags_taken_out_of_training(pst_root: Path) -> None:
    write_triple(pst_root / "test", "0_bag12_x")  # bags of the test part stay in it
    dataset = PST900(str(pst_root), val_bags=(12,))
    assert dataset.names("val") == (BAGS[2],)
    assert dataset.names("train") == tuple(sorted(BAGS[:2]))
    assert dataset.names("test") == ("0_bag12_x", *sorted(BAGS_TEST))
    assert dataset.splits["val"] == "train/rgb/*.png of the bags [12]"
    # 1 and 12 are apart: bag 2 is in no name.
    for bags in ((2,), (12, 21)):
        said = refused(lambda bags=bags: PST900(str(pst_root), val_bags=bags).names("train"))
        assert f"has no bag {bags[-1]}; its bags are [1, 12]" in said
    assert [bag_of(name) for name in ("bag7_x", "x_bag07_", "handbag7_x")] == [7, 7, None]
