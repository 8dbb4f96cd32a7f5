from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import yaml

from rgbt.checks import InputError
from rgbt.data.mfnet import CLASSES, PALETTE, MFNet
from rgbt.data.mfnet_layout import SPLITS, base_name

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared"))
REAL = SHARED / "realdata" / "mfnet200"
OFFICIAL = SHARED / "realdata" / "mfnet_names"


@pytest.mark.parametrize("layout", ["packed", "folders"])
def test_reads_both_layouts_in_rgb_order(write_mfnet, expected_pair, layout: str) -> None:
    root = write_mfnet({"train": ["00001D", "00002N"]}, layout=layout)
    dataset = MFNet(str(root))
    assert dataset.layout == layout
    sample = dataset.read("00002N")
    for found, expected in zip(
        (sample.rgb, sample.thermal, sample.label), expected_pair("00002N", (24, 32)), strict=True
    ):
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, expected)
    assert sample.name == "00002N"


def test_known_pixel(tmp_path: Path, png) -> None:
    """Channel by channel, so that neither B, G, R nor a dropped fourth channel can pass."""
    image = np.zeros((2, 3, 4), np.uint8)
    image[1, 2] = (10, 20, 30, 40)
    png(tmp_path / "images" / "00001D.png", image)
    png(tmp_path / "labels" / "00001D.png", np.full((2, 3), 8, np.uint8))
    sample = MFNet(str(tmp_path)).read("00001D")
    assert sample.rgb[1, 2].tolist() == [10, 20, 30]
    assert sample.thermal[1, 2] == 40
    assert sample.label is not None
    assert sample.label.tolist() == [[8, 8, 8], [8, 8, 8]]


def test_thermal_of_three_equal_channels(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]}, layout="folders")
    thermal = expected_pair("00001D", (24, 32))[1]
    png(root / "Thermal" / "00001D.png", np.dstack([thermal] * 3))
    np.testing.assert_array_equal(MFNet(str(root)).read("00001D").thermal, thermal)
    png(root / "Thermal" / "00001D.png", np.dstack([thermal, thermal, 255 - thermal]))
    with pytest.raises(InputError, match=r"Thermal.*three equal ones, got 3 channels that differ"):
        MFNet(str(root)).read("00001D")


def test_layout_is_found_or_as_asked(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]}, layout="folders")
    write_mfnet({"train": ["00001D"]}, layout="packed")
    assert MFNet(str(root)).layout == "packed"
    assert MFNet(str(root), layout="folders").layout == "folders"


def test_names_keep_the_order_of_the_list(write_mfnet) -> None:
    root = write_mfnet({"train": ["00003N", "00001D"]})
    (root / "train.txt").write_text("00003N\r\n\n 00001D \r\n")
    assert MFNet(str(root)).names("train") == ("00003N", "00001D")


def test_one_list_may_serve_two_splits(write_mfnet) -> None:
    root = write_mfnet({"val": ["00001D"]})
    dataset = MFNet(str(root), splits={"val": "val.txt", "test": "val.txt"})
    assert dataset.names("test") == dataset.names("val")


def test_day_and_night(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    names = ["00001D", "00001N", "00001D_flip", "00001N_flip"]
    assert [dataset.is_night(name) for name in names] == [False, True, False, True]
    assert base_name("00001N_flip") == "00001N"
    with pytest.raises(InputError, match="'frame7' has no time of day"):
        dataset.is_night("frame7")


def test_mirrored_copies_are_read_as_they_lie(write_mfnet, expected_pair) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip"]})
    sample = MFNet(str(root)).read("00001D_flip")
    np.testing.assert_array_equal(sample.rgb, expected_pair("00001D_flip", (24, 32))[0])
    (root / "images" / "00001D_flip.png").unlink()
    with pytest.raises(
        InputError, match=r"00001D_flip.png is missing; .* dataset.splits to a list"
    ):
        MFNet(str(root)).read("00001D_flip")


def test_fingerprint(write_mfnet) -> None:
    one = write_mfnet({"train": ["00001D", "00002N"]}, folder="one")
    other = write_mfnet({"train": ["00001D", "00002N"]}, folder="other")
    expected = MFNet(str(one)).fingerprint()
    assert len(expected) == 64
    assert MFNet(str(other)).fingerprint() == expected
    (other / "labels" / "00001D.png").write_bytes(b"shorter")
    assert MFNet(str(other)).fingerprint() != expected
    third = write_mfnet({"train": ["00002N", "00001D"]}, folder="third")
    assert MFNet(str(third)).fingerprint() != expected


def test_names_on_disk(write_mfnet, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    png(root / "labels" / "00009N.png", np.zeros((2, 2), np.uint8))
    (root / "images" / "Thumbs.db").write_bytes(b"")
    assert MFNet(str(root)).names_on_disk() == {"00001D", "00009N"}


def test_refuses_a_wrong_root(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"dataset.root: there is no folder '/nowhere'"):
        MFNet("/nowhere")
    with pytest.raises(InputError, match=r"does not hold the folders images\+labels or RGB"):
        MFNet(str(tmp_path))
    (tmp_path / "images").mkdir()
    (tmp_path / "labels").mkdir()
    with pytest.raises(InputError, match=r"does not hold the folders RGB\+Thermal\+Label"):
        MFNet(str(tmp_path), layout="folders")


def test_refuses_numbers_of_classes_that_disagree(write_mfnet) -> None:
    root = str(write_mfnet({"train": ["00001D"]}))
    with pytest.raises(InputError, match="num_classes is 5 but dataset.classes has 9"):
        MFNet(root, num_classes=5)
    with pytest.raises(InputError, match="num_classes is 2 but dataset.palette has 9"):
        MFNet(root, num_classes=2, classes=("road", "car"))


def test_refuses_wrong_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    dataset = MFNet(str(root))
    with pytest.raises(InputError, match=r"dataset.splits.val: there is no list .*val.txt"):
        dataset.names("val")
    with pytest.raises(InputError, match="no split 'trian'; did you mean 'train'?"):
        dataset.names("trian")
    (root / "test.txt").write_text("\n \n")
    with pytest.raises(InputError, match=r"dataset.splits.test: the list .* is empty"):
        dataset.names("test")


def test_refuses_other_channels_and_bits(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    dataset = MFNet(str(root))
    rgb, thermal, label = expected_pair("00001D", (24, 32))
    png(root / "images" / "00001D.png", rgb)
    with pytest.raises(InputError, match=r"images/00001D.png: expected 4 channels .*, got 3"):
        dataset.read("00001D")
    png(root / "images" / "00001D.png", np.dstack([rgb, thermal]).astype(np.uint16))
    with pytest.raises(InputError, match="expected 8 bits per channel, got uint16"):
        dataset.read("00001D")
    png(root / "images" / "00001D.png", np.dstack([rgb, thermal]))
    png(root / "labels" / "00001D.png", label.astype(np.uint16))
    with pytest.raises(InputError, match=r"labels/00001D.png: expected 8 bits"):
        dataset.read("00001D")
    png(root / "labels" / "00001D.png", rgb)
    with pytest.raises(InputError, match="expected one channel of class indices, got 3"):
        dataset.read("00001D")


def test_folders_layout_refuses_a_packed_image(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]}, layout="folders")
    rgb, thermal, _ = expected_pair("00001D", (24, 32))
    png(root / "RGB" / "00001D.png", np.dstack([rgb, thermal]))
    with pytest.raises(InputError, match=r"RGB/00001D.png: expected 3 channels .*, got 4"):
        MFNet(str(root)).read("00001D")
    png(root / "RGB" / "00001D.png", rgb[:, :30])
    with pytest.raises(InputError, match="RGB is 24x30 pixels but thermal is 24x32"):
        MFNet(str(root)).read("00001D")


def test_refuses_sizes_that_differ(write_mfnet, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    png(root / "labels" / "00001D.png", np.zeros((12, 16), np.uint8))
    with pytest.raises(InputError, match="'00001D': RGB is 24x32 pixels but its label is 12x"):
        MFNet(str(root)).read("00001D")


def test_labels_out_of_range_are_refused(write_mfnet, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    label = np.zeros((24, 32), np.uint8)
    label[0, :2] = (8, 255)
    png(root / "labels" / "00001D.png", label)
    assert MFNet(str(root)).read("00001D").label is not None
    label[3, 4] = 9
    png(root / "labels" / "00001D.png", label)
    with pytest.raises(InputError, match=r"labels/00001D.png: label value 9 is out of range"):
        MFNet(str(root)).read("00001D")


@pytest.mark.parametrize("folder", ["images", "labels"])
def test_refuses_damaged_files(write_mfnet, folder: str) -> None:
    root = write_mfnet({"train": ["00001D"]})
    path = root / folder / "00001D.png"
    whole = path.read_bytes()
    changed = bytearray(whole)
    changed[len(whole) // 2] ^= 0xFF
    for damaged in (whole[: len(whole) // 2], bytes(changed), b"", b"no image"):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=rf"{folder}/00001D.png cannot be decoded"):
            MFNet(str(root)).read("00001D")
    path.unlink()
    with pytest.raises(InputError, match=rf"{folder}/00001D.png is missing\.$"):
        MFNet(str(root)).read("00001D")


def test_configuration_repeats_the_defaults() -> None:
    node = yaml.safe_load((ROOT / "conf" / "dataset" / "mfnet.yaml").read_text())
    assert tuple(node["classes"]) == CLASSES
    assert tuple(map(tuple, node["palette"])) == PALETTE
    assert node["splits"] == SPLITS
    assert node["num_classes"] == 9


@pytest.mark.skipif(not REAL.exists(), reason="reference material is not here")
def test_reads_real_pairs() -> None:
    dataset = MFNet(str(REAL))
    assert len(dataset.names("train")) == len(dataset.names("val")) == 100
    sample = dataset.read(dataset.names("train")[0])
    assert sample.rgb.shape == (480, 640, 3)
    assert sample.thermal.shape == (480, 640)
    assert sample.label is not None
    assert sample.label.max() <= 8


@pytest.mark.skipif(not OFFICIAL.exists(), reason="reference material is not here")
def test_official_lists_by_letter(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    for path in OFFICIAL.glob("*.txt"):
        (root / path.name).write_text(path.read_text())
    dataset = MFNet(str(root))
    nights = {
        split: sum(map(dataset.is_night, dataset.names(split)))
        for split in ("train", "val", "test")
    }
    sizes = {split: len(dataset.names(split)) for split in nights}
    assert sizes == {"train": 784, "val": 392, "test": 393}
    assert nights == {"train": 374, "val": 187, "test": 188}
