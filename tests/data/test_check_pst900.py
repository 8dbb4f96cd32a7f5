from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.data.check import check_dataset, main
from rgbt.data.pst900 import PST900
from tests.conftest import write_png
from tests.data.pst900_files import HW, TEST, TRAIN, write_lists, write_pst900, write_triple

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


def notes(root: Path, **keys) -> tuple[str, ...]:
    report = check_dataset(PST900(str(root), **keys))
    assert report.problems == ()
    return report.notes


def run(root: Path) -> int | None:
    node = OmegaConf.load(ROOT / "conf/dataset/pst900.yaml")
    node.root = str(root)
    return main.__wrapped__(OmegaConf.create({"dataset": node}))


def test_a_sound_data_set(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    report = check_dataset(PST900(str(root)))
    assert report.problems == ()
    numbers = {split.split: (split.num_names, split.num_read) for split in report.splits}
    assert numbers == {"train": (3, 3), "val": (2, 2), "test": (2, 2)}
    assert all((split.num_day, split.num_night) == (0, 0) for split in report.splits)
    assert run(root) == 0
    output = capsys.readouterr().out
    assert "pst900 (PST900 in folders)" in output
    assert "0 problem(s)" in output


def test_notes(root: Path) -> None:
    thermal = np.full(HW, 7, np.uint8)  # 9 x 16 = 144 pixels, of each of three images
    thermal[0] = 0
    thermal[1, 0] = 3
    thermal[1, 1] = 200
    for name in TRAIN:
        write_png(root / "train/thermal" / f"{name}.png", thermal)
    found = notes(root)
    assert found[:3] == (
        "split val is the test part, as in the CRM release: a checkpoint chosen on it is chosen on "
        "what is reported; dataset.val_bags takes recordings out of training instead.",
        "split train has 3 images, the archive has 597.",
        "split test has 2 images, the archive has 288.",
    )
    assert found[3] == (
        "split test has 1 of bag 21, 1 of bag 25; the archive has 40 of bag 21, 59 of bag 22, 28 "
        "of bag 23, 72 of bag 24, 89 of bag 25."
    )
    assert found[4].startswith("images are 9x16, the original ones 720x1280: scores of resized")
    assert found[5] == (
        "split train: 11.11% of the thermal pixels are 0, which those without a measurement are; "
        "others run from 3 to 200."
    )
    assert found[6].startswith("split test: 0.00% of the thermal pixels are 0")
    assert len(found) == 7  # "val" would say what "test" says


def test_thermal_without_any_measurement(root: Path) -> None:
    for name in TEST:
        write_png(root / "test/thermal" / f"{name}.png", np.zeros(HW, np.uint8))
    assert notes(root)[-1].endswith(
        "100.00% of the thermal pixels are 0, which those without a "
        "measurement are; others run from 0 to 0."
    )


def test_bags_for_validation(root: Path) -> None:
    found = notes(root, val_bags=(12,))
    assert not any("split val is the test part" in note for note in found)
    assert not any("the archive has 597" in note for note in found)
    assert [note[:10] for note in found[-3:]] == ["split trai", "split val:", "split test"]


def test_published_numbers_are_of_pst900_alone(root: Path) -> None:
    found = notes(root, name="own")
    assert [note.partition(" ")[0] for note in found] == ["split"] * 3
    assert not any("archive" in note for note in found)


def test_the_whole_archive_by_name(tmp_path: Path) -> None:
    bags = {21: 40, 22: 59, 23: 28, 24: 72, 25: 89}
    test = [f"{index}_bag{bag}_x" for bag, count in bags.items() for index in range(count)]
    for part, names in (("train", [f"{index}_bag1_x" for index in range(597)]), ("test", test)):
        (tmp_path / part / "rgb").mkdir(parents=True)
        for name in names:
            (tmp_path / part / "rgb" / f"{name}.png").touch()
    found = check_dataset(PST900(str(tmp_path))).notes
    assert len(found) == 1
    assert found[0].startswith("split val is the test part")


def test_parts_that_are_exchanged(tmp_path: Path) -> None:
    found = notes(write_pst900(tmp_path / "all", train=TEST, test=TRAIN))
    assert (
        "split train is 2 images of the bags 21 to 25, which the archive has for testing: the "
        "folders train and test seem to be exchanged, as in the drawing on the data set's page; "
        "exchange them back." in found
    )
    assert any(note.startswith("split test has 2 of bag 1, 1 of bag 12; the") for note in found)
    found = notes(write_pst900(tmp_path / "some", train=(*TRAIN, TEST[0]), test=(TEST[1], "odd")))
    assert any(note.startswith("split train holds 1 images of the bags 21 to 25") for note in found)
    assert any(note.startswith("split test has 1 of no bag, 1 of bag 25; the") for note in found)


def test_each_problem_is_one_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_triple(root / "test", TRAIN[0])
    write_png(root / "train/labels" / f"{TEST[0]}.png", np.zeros(HW, np.uint8))
    (root / "train/rgb" / f"{TRAIN[1]}.png").unlink()
    write_png(root / "train/thermal" / f"{TRAIN[2]}.png", np.zeros(HW, np.uint16))
    write_png(root / "test/labels" / f"{TEST[0]}.png", np.full(HW, 5, np.uint8))
    (root / "test/rgb" / f"{TEST[1]}.png").write_bytes(b"damaged")
    found = check_dataset(PST900(str(root))).problems
    for text in (
        f"both train and test have an image called '{TRAIN[0]}'",
        "thermal_raw holds the counts",
        "label value 5 is out of range",
        f"rgb/{TEST[1]}.png cannot be decoded",
        f"splits train and test share 1 names, the first is '{TRAIN[0]}'.",
        f"3 files belong to no image of a split, the first is {root}/train/thermal/{TRAIN[1]}.png.",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 6
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_lists(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_lists(tmp_path, {"train": TRAIN, "test": (*TEST, TEST[0])})
    write_triple(root, "1_bag2_x")
    report = check_dataset(PST900(str(root)))
    assert report.problems == (
        f"split test lists '{TEST[0]}' 2 times.",
        f"3 files belong to no image of a split, the first is {root}/rgb/1_bag2_x.png.",
    )
    (root / "val.txt").write_text(TRAIN[0])
    problems = check_dataset(PST900(str(root))).problems
    assert f"splits train and val share 1 names, the first is '{TRAIN[0]}'." in problems
    assert run(root) == 1
    assert "(PST900 in lists)" in capsys.readouterr().out


def test_a_part_that_is_missing(tmp_path: Path) -> None:
    report = check_dataset(PST900(str(write_pst900(tmp_path, test=()))))
    assert [problem.partition(" of ")[0] for problem in report.problems] == ["split 'test'"]
    assert report.notes[0].startswith("split 'val' of pst900 is empty")
