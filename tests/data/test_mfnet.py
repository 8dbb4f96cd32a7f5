"""MFNet: its two layouts and its lists."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"


@pytest.mark.parametrize("layout", ["packed", "folders"])
def test_reads_both_layouts_in_rgb_order(write_mfnet, expected_pair, layout: str) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D", "00001D_flip"]}, layout=layout)))
    assert dataset.layout == layout
    for name in dataset.names("train"):  # mirrored copies are read as they are
        sample = dataset.read(name)
        arrays = (sample.rgb, sample.thermal, sample.label)
        for found, expected in zip(arrays, expected_pair(name, (24, 32)), strict=True):
            assert found.dtype == np.uint8
            np.testing.assert_array_equal(found, expected)
        assert sample.name == name


def test_layout_is_detected_or_as_configured(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]}, layout="folders")
    with pytest.raises(InputError, match=r"does not hold the folders images\+labels\."):
        MFNet(str(root), layout="packed")
    rgb, thermal, _ = expected_pair("00001D", (24, 32))
    png(root / "Thermal" / "00001D.png", np.dstack([thermal] * 3))
    np.testing.assert_array_equal(MFNet(str(root)).read("00001D").thermal, thermal)
    png(root / "Thermal" / "00001D.png", np.dstack([thermal, thermal, 255 - thermal]))
    with pytest.raises(
        InputError, match=r"Thermal.*three equal ones .*, got 3 channels that differ"
    ):
        MFNet(str(root)).read("00001D")
    png(root / "RGB" / "00001D.png", np.dstack([rgb, thermal]))
    with pytest.raises(InputError, match=r"RGB/00001D.png: expected 3 channels .*, got 4"):
        MFNet(str(root)).read("00001D")
    write_mfnet({"train": ["00001D"]}, layout="packed")
    assert MFNet(str(root)).layout == "packed"
    assert MFNet(str(root), layout="folders").layout == "folders"


def test_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00003N", "00001D"]})
    (root / "train.txt").write_text("00003N\r\n\n 00001D \r\n")
    dataset = MFNet(str(root), splits={"train": "train.txt", "val": "train.txt", "test": "no.txt"})
    assert dataset.names("train") == dataset.names("val") == ("00003N", "00001D")
    assert not dataset.has("test")
    with pytest.raises(InputError, match="split 'test' of mfnet is empty: expected no.txt"):
        dataset.names("test")


def test_day_and_night(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    names = ("00001D", "00001N", "00001D_flip", "00001N_flip")
    assert dataset.nights(names) == (False, True, False, True)
    assert dataset.nights(("frame7",)) is None
    with pytest.raises(InputError, match="'frame7' in .* does not state a time of day"):
        dataset.nights((*names, "frame7"))


def test_wrong_channels_and_bits_are_refused(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    rgb, thermal, label = expected_pair("00001D", (24, 32))
    packed = np.dstack([rgb, thermal])
    wrong = label.copy()
    wrong[3, 4] = 9
    for folder, image, said in (
        ("images", rgb, "expected 4 channels .*, got 3"),
        ("images", packed.astype(np.uint16), "RGBA images of 16 bits per channel are not read"),
        ("labels", label.astype(np.uint16), "expected 8 bits"),
        ("labels", rgb, "expected one channel of class indices .* mode RGB"),
        ("labels", wrong, "label value 9 .1 pixels"),
    ):
        write_mfnet({"train": ["00001D"]})
        png(root / folder / "00001D.png", image)
        with pytest.raises(InputError, match=rf"{folder}/00001D.png: {said}"):
            MFNet(str(root)).read("00001D")


@pytest.mark.skipif(not SHARED.exists(), reason="reference material is not here")
def test_real_pairs_and_official_lists(write_mfnet) -> None:
    sample = (real := MFNet(str(SHARED / "mfnet200"))).read(real.names("train")[0])
    assert (sample.rgb.shape, sample.thermal.shape) == ((480, 640, 3), (480, 640))
    assert sample.label.max() <= 8
    root = write_mfnet({"train": ["00001D"]})
    for path in (SHARED / "mfnet_names").glob("*.txt"):
        (root / path.name).write_text(path.read_text())
    dataset = MFNet(str(root))
    names = {split: dataset.names(split) for split in ("train", "val", "test")}
    assert {split: len(each) for split, each in names.items()} == {
        **{"train": 784, "val": 392, "test": 393}
    }
    assert [sum(dataset.nights(each)) for each in names.values()] == [374, 187, 188]
