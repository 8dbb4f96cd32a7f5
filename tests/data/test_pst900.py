from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from rgbt.checks import InputError
from rgbt.data.pst900 import CLASSES, PALETTE, PST900
from rgbt.data.pst900_layout import bag_of
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

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_pst900(tmp_path / "pst")


def test_reads_the_archive(root: Path) -> None:
    dataset = PST900(str(root))
    assert dataset.names("train") == tuple(sorted(TRAIN))
    assert dataset.names("test") == tuple(sorted(TEST))
    for name in (*TRAIN, *TEST):
        sample = dataset.read(name)
        arrays = (sample.rgb, sample.thermal, sample.label)
        for found, expected in zip(arrays, contents(name)):
            assert found is not None
            assert found.dtype == np.uint8
            np.testing.assert_array_equal(found, expected)
        assert sample.name == name
        np.testing.assert_array_equal(dataset.label(name), contents(name)[2])
        np.testing.assert_array_equal(dataset.thermal(name), contents(name)[1])
    assert dataset.splits == {
        "train": "train/rgb/*.png",
        "val": "test/rgb/*.png",
        "test": "test/rgb/*.png",
    }
    assert dataset.unscored == ()
    assert dataset.nights(dataset.names("train")) is None


def test_validation_is_the_test_part(root: Path) -> None:
    dataset = PST900(str(root))
    assert dataset.names("val") == dataset.names("test")
    assert dataset.has("val")


def test_bags_taken_out_of_training(root: Path) -> None:
    dataset = PST900(str(root), val_bags=(12,))
    assert dataset.names("val") == (TRAIN[2],)
    assert dataset.names("train") == tuple(sorted(TRAIN[:2]))
    assert dataset.names("test") == tuple(sorted(TEST))
    assert dataset.splits["val"] == "train/rgb/*.png of the bags [12]"
    assert dataset.splits["train"] == "train/rgb/*.png without the bags [12]"
    np.testing.assert_array_equal(dataset.read(TRAIN[2]).label, contents(TRAIN[2])[2])
    write_triple(root / "test", "0_bag12_x")  # bags of the test part stay in it
    assert PST900(str(root), val_bags=(12,)).names("test") == ("0_bag12_x", *sorted(TEST))


def test_bags_that_cannot_be_taken(root: Path) -> None:
    # 1 and 12 are apart: bag 2 is in no name.
    for bags in ((2,), (12, 21)):
        with pytest.raises(InputError, match=rf"val_bags: .* has no bag {bags[-1]}; .* are 1, 12"):
            PST900(str(root), val_bags=bags).names("val")
    dataset = PST900(str(root), val_bags=(1, 12))
    assert not dataset.has("train")
    with pytest.raises(InputError, match="'train' of pst900 is empty: .* remove one of them"):
        dataset.names("train")
    assert len(dataset.names("val")) == 3


@pytest.mark.parametrize(
    ("name", "bag"),
    [
        ("58_bag21_rect_rgb_frame0000000440", 21),
        ("bag3_x", 3),
        ("handbag3_x", None),
        ("1_bag3", None),
        ("", None),
    ],
)
def test_bag_of(name: str, bag: int | None) -> None:
    assert bag_of(name) == bag


def test_flat_folders_with_lists(tmp_path: Path) -> None:
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


def test_folders_come_before_lists(root: Path) -> None:
    write_lists(root, {split: (f"{split}_bag9_x",) for split in ("train", "val", "test")})
    assert PST900(str(root)).names("train") == tuple(sorted(TRAIN))
    assert PST900(str(root)).names("val") == tuple(sorted(TEST))


def test_files(root: Path) -> None:
    dataset = PST900(str(root))
    assert dataset.files(TRAIN[0]) == tuple(
        root / "train" / kind / f"{TRAIN[0]}.png" for kind in ("rgb", "thermal", "labels")
    )
    (root / "train/thermal" / f"{TRAIN[0]}.png").unlink()
    assert len(PST900(str(root)).files(TRAIN[0])) == 3
    with pytest.raises(InputError, match=r"train/thermal/10_bag1\S* is missing"):
        dataset.read(TRAIN[0])
    assert dataset.decoding() == {"num_classes": 5}


def test_fingerprint(tmp_path: Path) -> None:
    one, other = write_pst900(tmp_path / "one"), write_pst900(tmp_path / "other")
    expected = PST900(str(one)).fingerprint()
    assert len(expected) == 64
    assert PST900(str(other)).fingerprint() == expected
    assert PST900(str(other), val_bags=(1,)).fingerprint() != expected
    flat = write_lists(tmp_path / "flat", {"train": tuple(sorted(TRAIN)), "test": TEST[::-1]})
    assert PST900(str(flat)).fingerprint() == expected
    label = other / "test/labels" / f"{TEST[0]}.png"
    changed = {expected}
    for content in (b"shorter", b""):
        label.write_bytes(content)
        changed.add(PST900(str(other)).fingerprint())
    label.unlink()
    changed.add(PST900(str(other)).fingerprint())
    assert len(changed) == 4  # a file that is missing is no empty one


def test_a_part_that_is_missing(tmp_path: Path) -> None:
    dataset = PST900(str(write_pst900(tmp_path, test=())))
    assert [dataset.has(split) for split in ("train", "val", "test")] == [True, False, False]
    with pytest.raises(InputError, match=r"'val' of pst900 is empty: expected test/rgb/\*.png in"):
        dataset.names("val")
    assert len(dataset.fingerprint()) == 64
    assert dataset.read(TRAIN[0]).name == TRAIN[0]
    (tmp_path / "flat").mkdir()
    flat = PST900(str(write_lists(tmp_path / "flat", {"train": TRAIN})))
    assert not flat.has("test")
    with pytest.raises(InputError, match=r"split 'test' of pst900: .*test.txt is missing"):
        flat.names("test")


def test_a_name_in_both_parts(root: Path) -> None:
    write_pst900(root, (), (TRAIN[0],))
    dataset = PST900(str(root))
    for read in (dataset.read, dataset.label, dataset.files):
        with pytest.raises(InputError, match="both train and test have an image called '10_bag1"):
            read(TRAIN[0])
    assert dataset.read(TRAIN[1]).name == TRAIN[1]
    assert len(dataset.fingerprint()) == 64
    with pytest.raises(InputError, match="neither train nor test has an image called 'other'"):
        dataset.read("other")
    with pytest.raises(InputError, match="no split 'trian'; did you mean 'train'"):
        dataset.names("trian")


def test_refuses_a_wrong_root(root: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="there is no folder '/nowhere'"):
        PST900("/nowhere")
    for wrong in (tmp_path, root / "train"):
        with pytest.raises(InputError, match=rf"does not hold train/rgb .*; give {root}, which"):
            PST900(str(wrong))
    (tmp_path / "empty" / "deep").mkdir(parents=True)
    with pytest.raises(InputError, match="give the folder into which the archive was unpacked"):
        PST900(str(tmp_path / "empty" / "deep"))
    flat = write_lists(tmp_path / "a" / "flat", {"all": TRAIN})
    with pytest.raises(InputError, match=r"neither train.txt nor test.txt says which image"):
        PST900(str(flat))


def test_refuses_thermal_counts(root: Path) -> None:
    path = root / "train/thermal" / f"{TRAIN[0]}.png"
    write_png(path, np.full(HW, 30000, np.uint16))
    with pytest.raises(InputError, match="expected 8 bits .*, got uint16; .* thermal_raw holds"):
        PST900(str(root)).read(TRAIN[0])
    write_png(path, contents("x")[0])
    with pytest.raises(InputError, match=r"three equal ones, got 3 channels that differ by up to"):
        PST900(str(root)).read(TRAIN[0])
    write_png(path, np.dstack([contents("x")[1]] * 3))
    np.testing.assert_array_equal(PST900(str(root)).read(TRAIN[0]).thermal, contents("x")[1])
    write_png(path, np.dstack([contents("x")[1]] * 4))
    with pytest.raises(InputError, match=r"three equal ones, got 4 channels; the folder thermal"):
        PST900(str(root)).read(TRAIN[0])


def test_refuses_sizes_that_differ(root: Path) -> None:
    name = TEST[0]
    write_png(root / "test/labels" / f"{name}.png", contents(name, (9, 15))[2])
    with pytest.raises(InputError, match="RGB is 9x16 pixels but its label is 9x15; .*test/labels"):
        PST900(str(root)).read(name)
    write_png(root / "test/thermal" / f"{name}.png", contents(name, (8, 16))[1])
    with pytest.raises(InputError, match="RGB is 9x16 pixels but thermal is 8x16; .*test/thermal"):
        PST900(str(root)).read(name)


def test_labels_out_of_range_are_refused(root: Path) -> None:
    path = root / "train/labels" / f"{TRAIN[0]}.png"
    label = np.zeros(HW, np.uint8)
    label[0, :2] = (4, 255)
    write_png(path, label)
    np.testing.assert_array_equal(PST900(str(root)).label(TRAIN[0]), label)
    label[1, 1] = 5
    write_png(path, label)
    with pytest.raises(InputError, match=r"train/labels/\S+: label value 5 is out of range"):
        PST900(str(root)).read(TRAIN[0])


def test_refuses_links_out_of_the_root(root: Path, tmp_path: Path) -> None:
    inside = root / "train/rgb" / f"{TRAIN[0]}.png"
    inside.rename(tmp_path / "outside.png")
    inside.symlink_to(tmp_path / "outside.png")
    with pytest.raises(InputError, match="leads out of dataset.root"):
        PST900(str(root)).read(TRAIN[0])
    write_lists(tmp_path / "flat", {"train": ("../../pst/train/rgb/x",)})
    (root / "train/rgb/x.png").write_bytes(b"")
    with pytest.raises(InputError, match="leads out of dataset.root"):
        PST900(str(tmp_path / "flat")).read("../../pst/train/rgb/x")


def test_leaves_what_an_archiver_wrote_alone(root: Path) -> None:
    (root / "train/rgb" / f"._{TRAIN[0]}.png").write_bytes(b"")
    assert len(PST900(str(root)).names("train")) == 3


def test_configuration_repeats_the_defaults() -> None:
    node = yaml.safe_load((ROOT / "conf" / "dataset" / "pst900.yaml").read_text())
    assert tuple(node["classes"]) == CLASSES
    assert tuple(map(tuple, node["palette"])) == PALETTE
    assert node["num_classes"] == len(CLASSES)
    assert node["val_bags"] == []


def test_refuses_numbers_of_classes_that_disagree(root: Path) -> None:
    with pytest.raises(InputError, match="num_classes is 4 but dataset.classes has 5"):
        PST900(str(root), num_classes=4)
