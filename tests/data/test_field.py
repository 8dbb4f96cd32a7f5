"""Data sets of today: mocks of their layouts, real pairs, and splits of several lists."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose, load_choice
from rgbt.data.check import check_dataset
from rgbt.data.labels import label_codes
from rgbt.data.mfnet import MFNet
from rgbt.runs.folder import lists_of
from rgbt.types import IGNORE
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


# Label values as the releases state them, with the colours of the classes; -: not counted.
MFNET = """
0 unlabeled (0,0,0), 1 car (64,0,128), 2 person (64,64,0), 3 bike (0,128,192), 4 curve (0,0,192),
5 car_stop (128,128,0), 6 guardrail (64,64,128), 7 color_cone (192,128,128), 8 bump (192,64,0)"""
FMB = """
1 road (228,228,179), 2 sidewalk (133,57,181), 3 building (177,162,67), 4 lamp (50,178,200),
5 sign (199,45,132), 6 vegetation (84,172,66), 7 sky (79,73,179), 8 person (166,99,76),
9 car (253,121,66), 10 truck (91,165,137), 11 bus (152,97,155), 12 motorcycle (140,153,105),
13 bicycle (158,215,222), 14 pole (90,113,135)"""
STATED = {
    "fmb": "0 background (0,0,0)," + FMB,  # repositories that train on FMB
    "fmb_14": "0 -," + FMB,
    "msrs": MFNET,  # its labels are those of MFNet
    "video": re.sub(r" \([\d,]+\)", "", MFNET),
    "semanticrt": """
        0 background, 1 car_stop, 2 bike, 3 bicyclist, 4 motorcycle, 5 motorcyclist, 6 car,
        7 tricycle, 8 traffic_light, 9 box, 10 pole, 11 curve, 12 person""",
    "cart": """
        0 -, 1 -, 2 bare_ground (242,216,196), 3 rocky_terrain (89,70,54),
        4 structures (166,166,166), 5 road (82,89,90), 6 shrubs (155,230,0), 7 trees (0,138,53),
        8 sky (0,216,245), 9 water (13,127,252), 10 vehicles (255,249,0), 11 person (254,0,170)""",
    "mvseg": """
        0 background (0,0,0), 1 car (0,0,142), 2 bus (0,60,100), 3 motorcycle (0,0,230),
        4 bicycle (119,11,32), 5 pedestrian (255,0,0), 6 motorcyclist (0,139,139),
        7 bicyclist (255,165,150), 8 cart (192,64,0), 9 bench (211,211,211),
        10 umbrella (100,33,128), 11 box (117,79,86), 12 pole (153,153,153),
        13 street_lamp (190,122,222), 14 traffic_light (250,170,30), 15 traffic_sign (220,220,0),
        16 car_stop (222,142,35), 17 color_cone (205,155,155), 18 sky (70,130,180),
        19 road (128,64,128), 20 sidewalk (244,35,232), 21 curb (0,0,70),
        22 vegetation (107,142,35), 23 terrain (152,251,152), 24 building (70,70,70),
        25 ground (110,80,100)""",
}


@pytest.mark.parametrize("name", STATED)
def test_label_values_have_the_stated_classes(name: str) -> None:
    node = load_choice(f"dataset/{name}")
    classes, ids, ignored = node["classes"], node.get("ids"), node.get("ignored", ())
    stated = re.findall(r"(\d+) ([\w-]+)(?: \(([\d,]+)\))?", STATED[name])
    values = np.array([int(value) for value, _, _ in stated], np.uint8)
    read = label_codes(classes, ids, None, ignored).classes(values, Path(name)).tolist()
    found = ["-" if index == IGNORE else classes[index] for index in read]
    assert found == [word for _, word, _ in stated]
    assert len(classes) == node["num_classes"] == len(found) - found.count("-")
    colours = {word: colour for _, word, colour in stated if colour}
    for word, colour in zip(classes, node["palette"] if colours else (), strict=bool(colours)):
        assert ",".join(map(str, colour)) == colours[word], word


def test_both_protocols_of_fmb(tmp_path: Path) -> None:
    for part, number in (("train", 14), ("train", 0), ("test", 3)):
        places = [
            tmp_path / part / folder / f"{number:05d}.png"
            for folder in ("Visible", "Infrared", "Label")
        ]
        write_pair(*places, number)
    with_background, without = opened("fmb", tmp_path), opened("fmb_14", tmp_path)
    assert not check_dataset(with_background).problems
    assert (with_background.background, with_background.unscored) == (("background",), ())
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
