"""PST900: its layout, and recordings for validation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbt.data.check import check_dataset
from rgbt.data.pst900 import PST900, bag_of
from tests.conftest import write_png
from tests.data.layouts import BAGS, BAGS_TEST, of_pst900, refused, write_pst900, write_triple


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


def test_reads_the_archive(root: Path) -> None:
    (root / "train/rgb" / f"._{BAGS[0]}.png").write_bytes(b"")  # of an archiver
    dataset = PST900(str(root))
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


def test_bags_taken_out_of_training(root: Path) -> None:
    write_triple(root / "test", "0_bag12_x")  # bags of the test part stay in it
    dataset = PST900(str(root), val_bags=(12,))
    assert dataset.names("val") == (BAGS[2],)
    assert dataset.names("train") == tuple(sorted(BAGS[:2]))
    assert dataset.names("test") == ("0_bag12_x", *sorted(BAGS_TEST))
    assert dataset.splits["val"] == "train/rgb/*.png of the bags [12]"
    # 1 and 12 are apart: bag 2 is in no name.
    for bags in ((2,), (12, 21)):
        said = refused(lambda bags=bags: PST900(str(root), val_bags=bags).names("train"))
        assert f"has no bag {bags[-1]}; its bags are [1, 12]" in said
    said = refused(lambda: PST900(str(root), val_bags=(1, 12)).names("train"))
    assert "split 'train' of pst900 is empty" in said
    names = ("bag7_x", "x_bag07_", "handbag7_x", "x_bag7")
    assert [bag_of(name) for name in names] == [7, 7, None, None]


def test_thermal_counts_are_refused(root: Path) -> None:
    path = root / "train/thermal" / f"{BAGS[0]}.png"
    level = of_pst900("x")[1]
    for image, said in (
        (np.full((9, 16), 30000, np.uint16), "got uint16 of shape (9, 16); use the folder thermal"),
        (of_pst900("x")[0], "got 3 channels that differ by up to"),
        (np.dstack([level] * 4), "got 4 channels"),
    ):
        write_png(path, image)
        assert said in refused(lambda: PST900(str(root)).read(BAGS[0]))
    write_png(path, np.dstack([level] * 3))
    np.testing.assert_array_equal(PST900(str(root)).read(BAGS[0]).thermal, level)


def test_part_that_is_missing(tmp_path: Path) -> None:
    dataset = PST900(str(write_pst900(tmp_path, test=())))
    assert [dataset.has(split) for split in ("train", "val", "test")] == [True, False, False]
    report = check_dataset(dataset)
    assert [problem.partition(" of ")[0] for problem in report.problems] == ["split 'test'"]
    assert report.notes[0].startswith("split 'val' of pst900 is empty: expected test/rgb/*.png in")


def test_name_of_both_parts_is_refused_and_other_files_are_reported(root: Path) -> None:
    write_png(root / "train/labels" / f"{BAGS_TEST[0]}.png", np.zeros((9, 16), np.uint8))
    (root / "train/rgb" / f"{BAGS[1]}.png").unlink()
    assert check_dataset(PST900(str(root))).problems == (
        f"3 files belong to no image of a split; the first is {root}/train/labels/{BAGS[1]}.png.",
    )
    write_triple(root / "test", BAGS[0])
    said = refused(lambda: PST900(str(root)).read(BAGS[0]))
    assert f"both train and test have an image called '{BAGS[0]}'" in said
