"""Data sets of today: mocks of their layouts, real pairs, and splits of several lists."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.data.check import check_dataset
from rgbt.data.mfnet import MFNet
from rgbt.runs.folder import lists_of
from tests.conftest import write_png

HW = (4, 6)
REAL = Path(__file__).resolve().parents[3] / "shared" / "realdata" / "msrs50"


def opened(name: str, root: Path, *words: str) -> Any:
    return build(compose([f"dataset={name}", f"dataset.root={root}", *words]).dataset)


def write(path: Path, values: np.ndarray[Any, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), values)


def write_pair(rgb: Path, thermal: Path, label: Path, value: int) -> None:
    write(rgb, np.full((*HW, 3), value, np.uint8))
    counts = np.full(HW, value, np.uint16 if thermal.suffix == ".tiff" else np.uint8)
    counts[-1] = range(100, 100 + 20 * HW[1], 20)
    write(thermal, counts)
    write(label, np.full(HW, value, np.uint8))


def test_both_protocols_of_fmb(tmp_path: Path) -> None:
    for part, number in (("train", 14), ("train", 0), ("test", 3)):
        places = [
            tmp_path / part / folder / f"{number:05d}.png"
            for folder in ("Visible", "Infrared", "Label")
        ]
        write_pair(*places, number)
    with_background, without = opened("fmb", tmp_path), opened("fmb_14", tmp_path)
    assert not check_dataset(with_background).problems
    assert with_background.names("val") == with_background.names("test") == ("test_00003",)
    assert (with_background.classes[14], without.classes[13]) == ("pole", "pole")
    assert with_background.palette[14] == without.palette[13] == (90, 113, 135)
    found = {name: without.label(f"train_{name}").flat[0] for name in ("00014", "00000")}
    assert found == {"00014": 13, "00000": 255}
    assert with_background.label("train_00000").flat[0] == 0


def test_lists_and_layout_of_semanticrt(tmp_path: Path) -> None:
    for number in range(3):
        files = (f"rgb/{number}.jpg", f"thermal/{number}.jpg", f"labels/{number}.png")
        write_pair(*(tmp_path / file for file in files), number)
    for number, split in enumerate(("train", "val", "test")):
        (tmp_path / f"{split}.txt").write_text(f"{number}\n")
    data = opened("semanticrt", tmp_path)
    assert not check_dataset(data).problems
    assert (data.names("val"), data.label("2").flat[0], data.classes[12]) == (("1",), 2, "person")


def cart(root: Path, second: str) -> Any:
    place = root / "big_bear" / "ONR_1"
    for number in (2, 5, 7):
        write_pair(
            place / "rgb" / f"pair-{number:05d}.png",
            place / "thermal16" / f"thermal-{number:05d}.tiff",
            place / "masks" / f"pair-{number:05d}.png",
            number,
        )
    line = "big_bear/ONR_1/thermal16/thermal-{0}.tiff,big_bear/ONR_1/masks/pair-{1}.png\n"
    (root / "train.txt").write_text(line.format("00002", "00002"))
    (root / "val.txt").write_text(line.format("00005", "00005"))
    (root / "test.txt").write_text(line.format("00007", second))
    return opened("cart", root, "dataset.thermal_range=[0,510]")


def test_lines_of_cart_name_image_and_label(tmp_path: Path) -> None:
    data = cart(tmp_path, "00007")
    assert not check_dataset(data).problems
    (name,) = data.names("test")
    sample = data.read(name)
    assert (name, data.classes[sample.label.flat[0]]) == ("big_bear_ONR_1_00007", "trees")
    assert sample.thermal.flat[0] == 4  # 7 of 510, in grey levels: 3.5
    with pytest.raises(InputError, match=r"the label of 'big_bear_ONR_1_00007' is"):
        cart(tmp_path, "00002").names("test")


@pytest.mark.skipif(not REAL.is_dir(), reason="no real pairs")
def test_real_pairs_of_msrs(tmp_path: Path) -> None:
    lists = (f"test_{time}.txt" for time in ("day", "night"))
    for name in ((REAL / path).read_text().split()[0] for path in lists):
        packed = cv2.imread(str(REAL / "images" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        label = cv2.imread(str(REAL / "labels" / f"{name}.png"), cv2.IMREAD_UNCHANGED)
        for part in ("train", "test"):
            write(tmp_path / part / "vi" / f"{name}.png", packed[..., :3])
            write(tmp_path / part / "ir" / f"{name}.png", packed[..., 3])
            write(tmp_path / part / "Segmentation_labels" / f"{name}.png", label)
    data, same = opened("msrs", tmp_path), opened("mfnet", REAL, "dataset.splits.train=test.txt")
    assert not check_dataset(data).problems
    (day, night) = data.names("test")
    assert data.nights((day, night)) == (False, True)
    assert data.classes == same.classes
    for name in (day, night):
        mine, packed = data.read(name), same.read(name.removeprefix("test_"))
        assert np.array_equal(mine.rgb, packed.rgb)
        assert np.array_equal(mine.thermal, packed.thermal)
        assert np.array_equal(mine.label, packed.label)


def test_a_split_of_several_lists(tmp_path: Path) -> None:
    for number, split in enumerate(("train", "val", "test")):
        name = f"0000{number}D"
        write_png(tmp_path / "images" / f"{name}.png", np.zeros((*HW, 4), np.uint8))
        write_png(tmp_path / "labels" / f"{name}.png", np.zeros(HW, np.uint8))
        (tmp_path / f"{split}.txt").write_text(f"{name}\n")
    words = ["dataset.splits.train=[train.txt,val.txt]"]
    data = opened("mfnet", tmp_path, *words)
    assert data.names("train") == ("00000D", "00001D")
    assert data.names("val") == ("00001D",)
    assert data.splits["train"] == "train.txt+val.txt"
    assert data.fingerprint() != opened("mfnet", tmp_path).fingerprint()
    several = {"train": ("train.txt", "val.txt", "val.txt"), "val": "val.txt", "test": "test.txt"}
    with pytest.raises(InputError, match=r"dataset\.splits\.train: '00001D' is more than once"):
        MFNet(str(tmp_path), splits=several).names("train")
    missing = {**several, "train": ("train.txt", "none.txt")}
    with pytest.raises(InputError, match=r"none\.txt"):
        MFNet(str(tmp_path), splits=missing).names("train")


def test_lists_of_a_run_in_words() -> None:
    params = {
        "dataset.splits.train": "['train.txt', 'val.txt']",
        "dataset.splits.val": "val.txt",
        "trainer.selection_split": "val",
        "trainer.tested": "best",
        "domains.source.split": "train",
    }
    assert lists_of(params) == "trained on train.txt + val.txt, selected on val.txt"
    assert lists_of({**params, "trainer.tested": "last"}).endswith("val.txt, last checkpoint")
    assert lists_of({**params, "trainer.selection_split": "test"}).endswith("selected on test")
    assert lists_of({"domains.source.split": "train_day", "dataset.lists.train_day": "a.txt"}) == (
        "trained on a.txt, selected on val"
    )
