"""PST900: its two layouts, recordings for validation, and what the check finds in a copy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.pst900 import PST900
from rgbt.data.pst900_layout import bag_of
from rgbt.data.report import check_dataset
from tests.conftest import write_png
from tests.data.pst900_files import (
    HW,
    TEST,
    TRAIN,
    contents,
    write_lists,
    write_pst900,
    write_triple,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


def notes(root: Path, **keys) -> tuple[str, ...]:
    report = check_dataset(PST900(str(root), **keys))
    assert report.problems == ()
    return report.notes


def test_reads_the_archive(root: Path) -> None:
    (root / "train/rgb" / f"._{TRAIN[0]}.png").write_bytes(b"")  # of an archiver
    dataset = PST900(str(root))
    assert dataset.names("train") == tuple(sorted(TRAIN))
    assert dataset.names("val") == dataset.names("test") == tuple(sorted(TEST))
    for name in (*TRAIN, *TEST):
        sample = dataset.read(name)
        arrays = (sample.rgb, sample.thermal, sample.label)
        for found, expected in zip(arrays, contents(name), strict=True):
            assert found.dtype == np.uint8
            np.testing.assert_array_equal(found, expected)
        assert sample.name == name
    assert dataset.splits["val"] == "test/rgb/*.png"
    assert dataset.nights(dataset.names("train")) is None
    with pytest.raises(InputError, match="neither train nor test has an image called 'other'"):
        dataset.read("other")


def test_bags_taken_out_of_training(root: Path) -> None:
    write_triple(root / "test", "0_bag12_x")  # bags of the test part stay in it
    dataset = PST900(str(root), val_bags=(12,))
    assert dataset.names("val") == (TRAIN[2],)
    assert dataset.names("train") == tuple(sorted(TRAIN[:2]))
    assert dataset.names("test") == ("0_bag12_x", *sorted(TEST))
    assert dataset.splits["val"] == "train/rgb/*.png of the bags [12]"
    # 1 and 12 are apart: bag 2 is in no name.
    for bags in ((2,), (12, 21)):
        with pytest.raises(InputError, match=rf"val_bags: .* has no bag {bags[-1]}; .* are 1, 12"):
            PST900(str(root), val_bags=bags).names("train")
    with pytest.raises(InputError, match="every image is of a bag in dataset.val_bags"):
        PST900(str(root), val_bags=(1, 12)).names("train")
    assert [bag_of(name) for name in ("bag7_x", "x_bag07_", "handbag7_x", "x_bag7")] == [
        *(7, 7, None, None)
    ]


def test_lists_without_parts(tmp_path: Path) -> None:
    root = write_lists(tmp_path, {"train": TRAIN[::-1], "test": TEST})
    dataset = PST900(str(root))
    assert dataset.names("train") == TRAIN[::-1]  # in the order of the list
    assert dataset.names("val") == dataset.names("test") == TEST
    np.testing.assert_array_equal(dataset.read(TEST[0]).rgb, contents(TEST[0])[0])
    assert dataset.files(TEST[0])[1] == root / "thermal" / f"{TEST[0]}.png"
    (root / "test.txt").write_text(f"{TEST[1]}.png\n\n")
    assert PST900(str(root)).names("test") == TEST[1:]
    (root / "val.txt").write_text(TEST[0])
    dataset = PST900(str(root))
    assert (dataset.names("val"), dataset.splits["val"]) == (TEST[:1], "val.txt")
    assert PST900(str(root), val_bags=(12,)).names("val") == TRAIN[2:]
    write_pst900(root)  # parts come before lists
    assert PST900(str(root)).names("train") == tuple(sorted(TRAIN))


def test_both_layouts_have_one_fingerprint(root: Path, tmp_path: Path) -> None:
    expected = PST900(str(root)).fingerprint()
    assert PST900(str(root), val_bags=(1,)).fingerprint() != expected
    flat = write_lists(tmp_path / "flat", {"train": tuple(sorted(TRAIN)), "test": TEST[::-1]})
    assert PST900(str(flat)).fingerprint() == expected


def test_a_part_that_is_missing(tmp_path: Path) -> None:
    dataset = PST900(str(write_pst900(tmp_path, test=())))
    assert [dataset.has(split) for split in ("train", "val", "test")] == [True, False, False]
    assert len(dataset.fingerprint()) == 64
    report = check_dataset(dataset)
    assert [problem.partition(" of ")[0] for problem in report.problems] == ["split 'test'"]
    assert report.notes[0].startswith("split 'val' of pst900 is empty: expected test/rgb/*.png in")
    flat = PST900(str(write_lists(tmp_path / "flat", {"train": TRAIN})))
    assert not flat.has("test")
    with pytest.raises(InputError, match=r"the list '.*test.txt' does not exist"):
        flat.names("test")


def test_wrong_roots_are_refused(root: Path, tmp_path: Path) -> None:
    for wrong in (tmp_path, root / "train"):
        with pytest.raises(InputError, match=rf"does not hold train/rgb .*; give {root}, which"):
            PST900(str(wrong))
    (tmp_path / "empty" / "deep").mkdir(parents=True)
    with pytest.raises(InputError, match="give the folder into which the archive was unpacked"):
        PST900(str(tmp_path / "empty" / "deep"))
    flat = write_lists(tmp_path / "a" / "flat", {"all": TRAIN})
    with pytest.raises(InputError, match=r"neither train.txt nor test.txt. Write these lists"):
        PST900(str(flat))


def test_thermal_counts_are_refused(root: Path) -> None:
    path = root / "train/thermal" / f"{TRAIN[0]}.png"
    level = contents("x")[1]
    for image, said in (
        (np.full(HW, 30000, np.uint16), "expected 8 bits .*, got uint16; .* thermal_raw holds"),
        (contents("x")[0], r"three equal ones, got 3 channels that differ by up to"),
        (np.dstack([level] * 4), r"three equal ones, got 4 channels; use the folder thermal"),
    ):
        write_png(path, image)
        with pytest.raises(InputError, match=said):
            PST900(str(root)).read(TRAIN[0])
    write_png(path, np.dstack([level] * 3))
    np.testing.assert_array_equal(PST900(str(root)).read(TRAIN[0]).thermal, level)


def test_list_line_outside_the_root_is_refused(root: Path, tmp_path: Path) -> None:
    write_lists(tmp_path / "flat", {"train": ("../../pst/train/rgb/x",)})
    (root / "train/rgb/x.png").write_bytes(b"")
    with pytest.raises(InputError, match="leads out of dataset.root"):
        PST900(str(tmp_path / "flat")).read("../../pst/train/rgb/x")


def test_check_notes(root: Path) -> None:
    thermal = np.full(HW, 7, np.uint8)  # 9 x 16 = 144 pixels, of each of three images
    thermal[0] = 0
    thermal[1, :2] = (3, 200)
    for name in TRAIN:
        write_png(root / "train/thermal" / f"{name}.png", thermal)
    for name in TEST:
        write_png(root / "test/thermal" / f"{name}.png", np.zeros(HW, np.uint8))
    found = notes(root)
    for start, note in zip(
        (
            "split val is the test part, as in the CRM release, so the best checkpoint is selected",
            "split test has 1 of bag 21, 1 of bag 25; the archive has 40 of bag 21, 59 of bag 22,",
            "split train has 3 images, but the archive has 597.",
            "split test has 2 images, but the archive has 288.",
            "images are 9x16, but the original images are 720x1280. Scores on resized",
            "split train: 11.11% of the thermal pixels are 0, which marks pixels without a "
            "measurement; the others range from 3 to 200.",
            "split test: 100.00% of the thermal pixels are 0",
        ),
        found,
        strict=True,  # "val" would repeat "test"
    ):
        assert note.startswith(start)
    bags = notes(root, val_bags=(12,))
    assert not any("is the test part" in note or "has 597" in note for note in bags)
    assert [note[:10] for note in bags[-3:]] == ["split trai", "split val:", "split test"]
    assert not any("archive" in note for note in notes(root, name="own"))


def test_check_of_whole_and_exchanged_parts(tmp_path: Path) -> None:
    bags = {21: 40, 22: 59, 23: 28, 24: 72, 25: 89}
    test = [f"{index}_bag{bag}_x" for bag, count in bags.items() for index in range(count)]
    for part, names in (("train", [f"{index}_bag1_x" for index in range(597)]), ("test", test)):
        (tmp_path / part / "rgb").mkdir(parents=True)
        for name in names:
            (tmp_path / part / "rgb" / f"{name}.png").touch()
    assert len(check_dataset(PST900(str(tmp_path))).notes) == 1
    found = notes(write_pst900(tmp_path / "all", train=TEST, test=TRAIN))
    assert any("split train is 2 images of the bags 21 to 25" in note for note in found)
    assert any(note.startswith("split test has 2 of bag 1, 1 of bag 12; the") for note in found)
    found = notes(write_pst900(tmp_path / "some", train=(*TRAIN, TEST[0]), test=(TEST[1], "odd")))
    assert any(note.startswith("split train holds 1 images of the bags 21 to 25") for note in found)
    assert any(note.startswith("split test has 1 of no bag, 1 of bag 25; the") for note in found)


def test_check_finds_each_problem_once(root: Path, tmp_path: Path) -> None:
    write_triple(root / "test", TRAIN[0])
    write_png(root / "train/labels" / f"{TEST[0]}.png", np.zeros(HW, np.uint8))
    (root / "train/rgb" / f"{TRAIN[1]}.png").unlink()
    dataset = PST900(str(root))
    assert len(dataset.fingerprint()) == 64
    assert dataset.read(TRAIN[2]).name == TRAIN[2]
    for text in (
        f"both train and test have an image called '{TRAIN[0]}'",
        f"splits train and test share 1 names; the first is '{TRAIN[0]}'.",
        f"3 files belong to no image of a split; the first is {root}/train/labels/{TRAIN[1]}.png.",
    ):
        assert sum(text in line for line in check_dataset(dataset).problems) == 1, text
    assert len(check_dataset(dataset).problems) == 3
    flat = write_lists(tmp_path / "flat", {"train": TRAIN, "test": (*TEST, TEST[0])})
    write_triple(flat, "1_bag2_x")
    assert check_dataset(PST900(str(flat))).problems == (
        f"split test lists '{TEST[0]}' 2 times.",
        f"3 files belong to no image of a split; the first is {flat}/labels/1_bag2_x.png.",
    )
