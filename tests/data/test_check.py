"""The command ``rgbt check``: numbers of a split, problems, and what a split lacks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.data.check import DatasetReport, check_dataset, grouped, lonely_values, main
from rgbt.data.folder import Folder
from rgbt.data.mfnet import MFNet
from tests.conftest import write_png
from tests.data.layouts import write_any

ROOT = Path(__file__).resolve().parents[2]
SPLITS = {"train": ["00001D", "00002N"], "val": ["00003N", "00005D"], "test": ["00004D", "00006N"]}

Png = Callable[[Path, np.ndarray], None]


def checked(root: Path, *splits: str) -> DatasetReport:
    lists = {"splits": {split: f"{split}.txt" for split in splits}} if splits else {}
    return check_dataset(MFNet(str(root), **lists))


def run(root: Path) -> int | None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "mfnet.yaml")
    node.root = str(root)
    return main.__wrapped__(OmegaConf.create({"dataset": node}), [])


def test_check_counts_a_split(write_mfnet, png: Png) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip", "00002N"]})
    first = np.zeros((24, 32), np.uint8)
    first[0, :4] = (1, 1, 2, 255)
    second = np.zeros((24, 32), np.uint8)
    second[0, 0] = 1
    for name, label in (("00001D", first), ("00001D_flip", first), ("00002N", second)):
        png(root / "labels" / f"{name}.png", label)
    split = checked(root, "train").splits["train"]
    assert (split.names, split.read, split.mirrored) == (3, 3, 1)
    assert (split.day, split.night) == (1, 1)
    assert split.sizes == {(24, 32): 3}
    assert split.pixels[[1, 2, 9]].tolist() == [5, 2, 2]
    assert split.images[[0, 1, 2, 3, 9]].tolist() == [3, 3, 2, 0, 2]
    assert split.pixels.sum() == 3 * 24 * 32


def test_check_finds_each_problem_once(write_mfnet, expected_pair, png: Png, capsys) -> None:
    root = write_mfnet(SPLITS)
    assert run(root) == 0
    output = capsys.readouterr()
    assert "mfnet (MFNet)" in output.out
    assert "24x32 (2)" in output.out
    assert "0 problem(s), 2 note(s)" in output.out  # no lists of the test by day and at night
    names = [f"{number:05d}D" for number in range(10, 17)]
    lists = {"train": [*names, "00003N"], "val": ["00003N", "00003N", "00003N_flip"]}
    write_mfnet({**SPLITS, **lists, "test_day": ["00004D", "00002N"], "test_night": ["00004D"]})
    rgb, thermal, _ = expected_pair("x", (24, 32))
    (root / "labels" / "00011D.png").unlink()
    png(root / "images" / "00099D.png", np.dstack([rgb, thermal]))
    found = checked(root).problems
    for text in (
        "labels/00011D.png is missing",
        "split val lists '00003N' 2 times",
        "split val lists 1 mirrored copies",
        "splits train and val share 1 names; the first is '00003N'",
        "split test_day lists '00002N', which is a night image",
        "split test_night lists '00004D', which is a day image",
        "splits test_day and test_night share 1 names",
        "5 files belong to no image of a split; the first is",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 8
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_check_of_missing_and_shared_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    report = checked(root)
    assert len(report.problems) == 2
    assert "expected test.txt in" in report.problems[1]
    # The parts by time of day only repeat what other lists hold.
    assert sum("test_day.txt" in note or "test_night.txt" in note for note in report.notes) == 2
    shared = MFNet(str(root), splits={"val": "train.txt", "test": "train.txt"})
    report = check_dataset(shared)
    assert report.problems == ()
    assert "splits val and test are one list: test has no image unseen in val." in report.notes
    assert not any("are one list" in note for note in checked(write_mfnet(SPLITS)).notes)


def test_check_shows_the_range_of_many_sizes(write_mfnet, capsys) -> None:
    root = write_mfnet(SPLITS)
    names = [f"{number:05d}D" for number in range(10, 15)]
    for number, name in enumerate(names):
        write_mfnet({"train": [name]}, (20 + number, 30))
    (root / "train.txt").write_text("\n".join(names))
    run(root)
    out = capsys.readouterr().out
    assert "20x30 (1) to 24x30 (1), 5 sizes" in out
    expected = "train with 'scale.crop_hw=[20,30]' or less, and data.eval_batch_size=1."
    assert f"images differ in size (20x30 to 24x32); {expected}" in out


def test_check_notes_what_a_split_lacks(write_mfnet, png: Png) -> None:
    root = write_mfnet(SPLITS)
    for split, names in SPLITS.items():
        for name in names:
            label = np.ones((24, 32), np.uint8)
            label[0] = 0 if split == "test" else 5
            label[1, 0] = 8 if name == "00001D" else 1
            png(root / "labels" / f"{name}.png", label)
    end = ", which other splits have; a score of it says nothing about them."
    assert checked(root, *SPLITS).notes == (
        "no label shows 'person', 'bike', 'curve', 'guardrail', 'color_cone'; no score says "
        "anything about it.",
        f"split train has no 'unlabeled'{end}",
        f"split val has no 'unlabeled', 'bump'{end}",
        f"split test has no 'car_stop', 'bump'{end}",
    )
    for name, time in (("00004D", "night"), ("00006N", "day")):
        (root / "test.txt").write_text(f"{name}\n")
        last = checked(root, *SPLITS).notes[-1]
        assert last.startswith(f"split test has no {time} images, 'car_stop'")


def test_names_reach_the_terminal_without_control_characters(write_mfnet, capsys) -> None:
    root = write_mfnet({**SPLITS, "train": ["00001D", "0\x1b[2J1D"]})
    (root / "labels" / "0\x1b[2J1D.png").unlink()
    assert run(root) == 1
    output = capsys.readouterr()
    assert "0?[2J1D" in output.out
    assert "\x1b[2J" not in output.out + output.err


RAMP = np.arange(24, dtype=np.uint8).reshape(4, 6)


def own(root: Path, label: np.ndarray | None = None, **keys: Any) -> Folder:
    """Two images of each split, whose labels show both classes, or `label`."""
    for split in ("train", "val", "test"):
        for number in "12":
            write_png(root / split / "rgb" / f"{number}.png", np.dstack([RAMP] * 3))
            if not (root / split / "ir").is_dir() or "thermal" not in keys:
                write_png(root / split / "ir" / f"{number}.png", RAMP)
            write_png(root / split / "gt" / f"{number}.png", RAMP % 2 if label is None else label)
    places = {key: f"{{split}}/{key}/{{name}}.png" for key in ("rgb", "ir", "gt")}
    settings = {"rgb": places["rgb"], "thermal": places["ir"], "label": places["gt"], **keys}
    return Folder(str(root), num_classes=2, classes=("ground", "object"), **settings)


@pytest.mark.parametrize(
    ("values", "keys", "said"),
    [
        ((0, 255), {}, "write ids: {0: ground, 255: object} if it is a class, ignored: [255] if"),
        ((1, 255), {}, "write ids: {1: object, 255: ground} if it is a class"),
        ((255, 255), {}, "the labels show no class and 255 (100.0% of the pixels"),
        ((255, 255), {"ids": {7: "object"}}, "write ids: {0: ground, 255: object} if it is a"),
        ((0, 255), {"ids": {0: "ground", 1: "object"}}, "'ground' alone and 255 (50.0% of the"),
        ((0, 255), {"ignored": (255,)}, "'ground' alone; a score over one class is no score."),
        ((0, 0), {}, "'ground' alone; a score over one class is no score."),
        ((0, 128), {}, "label value 128 (12 pixels; one of 1 unknown values) has no class in"),
        ((0, 128), {}, "write ids: {..., 128: CLASS}, or ignored: [128]."),
        ((0, 255), {"ids": {0: "ground", 255: "object"}}, None),
        ((0, 128), {"ids": {0: "ground", 128: "object"}}, None),
    ],
)
def test_masks_of_one_class_are_a_problem(
    tmp_path: Path, values: tuple[int, int], keys: dict[str, Any], said: str | None
) -> None:
    """255 is no class and ignored by nothing but habit, unless the data set says what it is."""
    dataset = own(tmp_path, np.where(RAMP % 2, *values[::-1]).astype(np.uint8), **keys)
    report = check_dataset(dataset)
    if said is None:
        assert report.problems == ()
        assert report.splits["test"].pixels.tolist() == [24, 24, 0]
    else:
        assert len(report.problems) == 1
        assert said in report.problems[0]


def test_255_is_ignored_beside_other_classes(tmp_path: Path, write_mfnet, png: Png) -> None:
    label = RAMP % 2
    label[0] = 255
    report = check_dataset(own(tmp_path, label))
    assert (report.problems, report.notes) == ((), ())
    assert report.splits["test"].pixels.tolist() == [18, 18, 12]
    # A reader whose values are fixed has no setting for them.
    root = write_mfnet(SPLITS)
    for path in (root / "labels").iterdir():
        png(path, np.where(np.eye(24, 32) > 0, 255, 0).astype(np.uint8))
    (problem,) = checked(root, *SPLITS).problems
    assert "'unlabeled' alone and 255 (3.1% of the pixels, ignored); write the index" in problem


def test_problems_of_one_kind_are_one_line(tmp_path: Path) -> None:
    dataset = own(tmp_path)
    for split in ("train", "test"):
        for number in "12":
            (tmp_path / split / "ir" / f"{number}.png").unlink()
    write_png(tmp_path / "val" / "gt" / "1.png", np.full((4, 6), 7, np.uint8))
    write_png(tmp_path / "val" / "gt" / "2.png", np.full((4, 6), 8, np.uint8))
    first, *others = check_dataset(dataset).problems
    gone = tmp_path / "train" / "ir" / "1.png"
    assert first.startswith(f"4 times (train_1, train_2, test_1, ...): {gone} is missing")
    # The value is what is wrong, not a number that differs from image to image.
    assert [value in line for value, line in zip("78", others, strict=True)] == [True, True]
    said = [("1", "/a/1.png has 31 pixels."), ("3", "/a/3.png has 3 pixels."), ("3", "flat")]
    assert grouped(said) == ("2 times (1, 3): /a/1.png has 31 pixels.", "3: flat")


@pytest.mark.parametrize("turned", ["rgb", "ir", "gt"])
def test_the_turned_one_of_three_files_is_named(tmp_path: Path, turned: str) -> None:
    dataset = own(tmp_path)
    path = tmp_path / "val" / turned / "2.png"
    write_png(path, np.dstack([RAMP.T] * 3) if turned == "rgb" else RAMP.T % 2)
    (problem,) = check_dataset(dataset).problems
    assert problem.startswith("'val_2': RGB is ")
    assert problem.endswith(f"; {path} is turned by a quarter; turn it as the others are.")


def test_thermal_without_data_is_reported(tmp_path: Path) -> None:
    """Of real numbers, of sixteen bits, and one image of another type; one that shows nothing."""
    kelvin = 300 + RAMP.astype(np.float32) / 8
    hole = np.where(RAMP == 5, np.float32(-9999), kelvin)
    images = {"train_1": hole, "train_2": hole, "val_1": 0 * kelvin, "val_2": kelvin + 200}
    images |= {"test_1": kelvin, "test_2": 300 + RAMP.astype(np.uint16) // 8}
    for name, image in images.items():
        split, number = name.split("_")
        write_any(tmp_path / split / "ir" / f"{number}.tif", image)
    keys = {"thermal": "{split}/ir/{name}.tif", "thermal_range": (290, 310)}
    report = check_dataset(own(tmp_path, **keys))
    assert report.problems == (
        "val_1: thermal is one grey level everywhere; replace the image.",
        "val_2: thermal is one grey level everywhere; see dataset.thermal_range.",
        "test_2: thermal is uint16, of most images float; store values of one type.",
    )
    assert report.notes == (
        "2 times (train_1, train_2): thermal value -9999 is far from all others (no data?), and "
        "used as it is.",
    )
    write_any(tmp_path / "test" / "ir" / "1.tif", np.where(RAMP == 5, np.float32(np.nan), kelvin))
    assert (
        "1 thermal values are NaN or infinite" in check_dataset(own(tmp_path, **keys)).problems[0]
    )


def test_lonely_values_by_hand() -> None:
    """0 is 21000 away from all others, which are at most 2900 from each other."""
    counts = list(range(21000, 24000, 100))
    for values, expected in (
        ([0, *counts], [0]),
        ([*counts, 65535], [65535]),
        ([-32768, -9999, *range(20, 40)], [-32768, -9999]),
        ([0, *counts, 65535], [65535, 0]),
        ([18200, *counts], []),  # 2800 away
        (counts, []),
        ([7, 7, 7], []),
        ([0, 9], []),
    ):
        assert lonely_values(np.array(values)) == expected
