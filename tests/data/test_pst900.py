"""PST900: its layout, and recordings for validation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.check import check_dataset
from rgbt.data.pst900 import PST900, bag_of
from tests.conftest import write_png
from tests.data.pst900_files import (
    HW,
    TEST,
    TRAIN,
    contents,
    write_pst900,
    write_triple,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


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
        with pytest.raises(
            InputError, match=rf"val_bags: .* has no bag {bags[-1]}; .* are \[1, 12\]"
        ):
            PST900(str(root), val_bags=bags).names("train")
    with pytest.raises(InputError, match="split 'train' of pst900 is empty"):
        PST900(str(root), val_bags=(1, 12)).names("train")
    assert [bag_of(name) for name in ("bag7_x", "x_bag07_", "handbag7_x", "x_bag7")] == [
        *(7, 7, None, None)
    ]


def test_thermal_counts_are_refused(root: Path) -> None:
    path = root / "train/thermal" / f"{TRAIN[0]}.png"
    level = contents("x")[1]
    for image, said in (
        (
            np.full(HW, 30000, np.uint16),
            "expected .* 8 bits .*, got uint16 .* thermal_raw is not supp",
        ),
        (contents("x")[0], r"three equal ones .*, got 3 channels that differ by up to"),
        (np.dstack([level] * 4), r"three equal ones .*, got 4 channels .*; use the folder thermal"),
    ):
        write_png(path, image)
        with pytest.raises(InputError, match=said):
            PST900(str(root)).read(TRAIN[0])
    write_png(path, np.dstack([level] * 3))
    np.testing.assert_array_equal(PST900(str(root)).read(TRAIN[0]).thermal, level)


def test_part_that_is_missing(tmp_path: Path) -> None:
    dataset = PST900(str(write_pst900(tmp_path, test=())))
    assert [dataset.has(split) for split in ("train", "val", "test")] == [True, False, False]
    assert len(dataset.fingerprint()) == 64
    report = check_dataset(dataset)
    assert [problem.partition(" of ")[0] for problem in report.problems] == ["split 'test'"]
    assert report.notes[0].startswith("split 'val' of pst900 is empty: expected test/rgb/*.png in")
    with pytest.raises(InputError, match="does not hold train/rgb or test/rgb"):
        PST900(str(tmp_path / "train"))


def test_name_of_both_parts_is_refused_and_other_files_are_reported(root: Path) -> None:
    write_png(root / "train/labels" / f"{TEST[0]}.png", np.zeros(HW, np.uint8))
    (root / "train/rgb" / f"{TRAIN[1]}.png").unlink()
    assert check_dataset(PST900(str(root))).problems == (
        f"3 files belong to no image of a split; the first is {root}/train/labels/{TRAIN[1]}.png.",
    )
    write_triple(root / "test", TRAIN[0])
    with pytest.raises(InputError, match=f"both train and test have an image called '{TRAIN[0]}'"):
        PST900(str(root)).read(TRAIN[0])
