"""MFNet: its two layouts and its lists; true second frames, and where their points were."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from rgbt.data.mfnet import MFNet, NextFrames
from tests.conftest import write_data
from tests.data.layouts import refused

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
    said = refused(lambda: MFNet(str(root), layout="packed"))
    assert "does not hold the folders images+labels." in said
    _, thermal, _ = expected_pair("00001D", (24, 32))
    png(root / "Thermal" / "00001D.png", np.dstack([thermal] * 3))
    np.testing.assert_array_equal(MFNet(str(root)).read("00001D").thermal, thermal)
    write_mfnet({"train": ["00001D"]}, layout="packed")
    assert MFNet(str(root)).layout == "packed"
    assert MFNet(str(root), layout="folders").layout == "folders"


def test_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00003N", "00001D"]})
    (root / "train.txt").write_text("00003N\r\n\n 00001D \r\n")
    dataset = MFNet(str(root), splits={"train": "train.txt", "val": "train.txt", "test": "no.txt"})
    assert dataset.names("train") == dataset.names("val") == ("00003N", "00001D")
    assert not dataset.has("test")
    said = refused(lambda: dataset.names("test"))
    assert "split 'test' of mfnet is empty: expected no.txt" in said


def test_day_and_night(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    names = ("00001D", "00001N", "00001D_flip", "00001N_flip")
    assert dataset.nights(names) == (False, True, False, True)
    assert dataset.nights(("frame7",)) is None
    assert "'frame7'" in refused(lambda: dataset.nights((*names, "frame7")))


def test_wrong_channels_and_bits_are_refused(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    rgb, thermal, label = expected_pair("00001D", (24, 32))
    packed = np.dstack([rgb, thermal])
    wrong = label.copy()
    wrong[3, 4] = 9
    for folder, image, said in (
        ("images", rgb, "got 3; use the original file"),
        ("images", packed.astype(np.uint16), "RGBA images of 16 bits per channel are not read"),
        ("labels", label.astype(np.uint16), "expected 8 bits"),
        ("labels", rgb, "got PNG of mode RGB"),
        ("labels", wrong, "label value 9 (1 pixels"),
    ):
        write_mfnet({"train": ["00001D"]})
        png(root / folder / "00001D.png", image)
        told = refused(lambda: MFNet(str(root)).read("00001D"))
        assert f"{folder}/00001D.png: " in told
        assert said in told


@pytest.mark.skipif(not SHARED.exists(), reason="reference material is not here")
def test_real_pairs_and_official_lists(write_mfnet) -> None:
    sample = (real := MFNet(str(SHARED / "mfnet200"))).read(real.names("train")[0])
    assert (sample.rgb.shape, sample.thermal.shape) == ((480, 640, 3), (480, 640))
    assert sample.label.max() <= 8
    root = write_mfnet({"train": ["00001D"]})
    for path in (SHARED / "mfnet_names").glob("*.txt"):
        (root / path.name).write_text(path.read_text())
    dataset = MFNet(str(root))
    names = [dataset.names(split) for split in ("train", "val", "test")]
    assert [len(each) for each in names] == [784, 392, 393]
    assert [sum(dataset.nights(each)) for each in names] == [374, 187, 188]


# Second frames.

HW = (6, 8)
NAMES = ("00001D", "00002N")
STILL = np.zeros((*HW, 2), np.float32)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Two frames; the second moment of the first one has no motion."""
    for folder in (tmp_path / "mf", tmp_path / "mf" / "next"):
        write_data(folder, {"test": list(NAMES)}, HW)
    (tmp_path / "mf" / "next" / "flow").mkdir()
    np.save(tmp_path / "mf" / "next" / "flow" / NAMES[0], STILL)
    return tmp_path / "mf"


def second(root: Path) -> NextFrames:
    return NextFrames(MFNet(str(root), name="mf", splits={"test": "test.txt"}))


def test_second_frames_are_read_like_first(root: Path) -> None:
    after = second(root)
    assert after.dataset.root == root / "next"
    assert after.dataset.names("test") == NAMES
    assert after.dataset.read(NAMES[0]).label.shape == HW
    for found, expected in zip(after.source(NAMES[0], HW), np.mgrid[:6, :8], strict=True):
        assert found.dtype == np.int64
        assert np.array_equal(found, expected)


def test_flow_is_rows_columns_to_nearest_pixel(root: Path) -> None:
    flow = STILL.copy()
    flow[2, 3] = (1.4, -2.6)  # (3.4, 0.4): row 3, column 0
    flow[5, 7] = (0.4, 0.4)
    flow[0, 0] = np.nan  # hidden
    flow[0, 1] = (np.nan, 0)
    flow[0, 2] = (0, np.inf)
    np.save(root / "next" / "flow" / NAMES[0], flow)
    rows, columns = second(root).source(NAMES[0], HW)
    assert (rows[2, 3], columns[2, 3]) == (3, 0)
    assert (rows[5, 7], columns[5, 7]) == (5, 7)
    assert rows[0, :3].tolist() == columns[0, :3].tolist() == [-1] * 3
    assert (rows == -1).sum() == 3


@pytest.mark.parametrize(
    ("flow", "said"),
    [
        (STILL[:, :7], "shape (6, 8, 2) (rows, columns) like its frame, got float32 of shape (6,"),
        (STILL - (1, 0), "points outside the first frame of 6x8"),
        (STILL + (0.6, 0), "points outside the first frame"),
        (np.array([{}], object), "cannot be read"),
        (np.full((*HW, 2), "far"), "expected real numbers"),
        (None, "is missing"),
    ],
)
def test_invalid_flow_is_refused(root: Path, flow: np.ndarray | None, said: str) -> None:
    path = root / "next" / "flow" / f"{NAMES[0]}.npy"
    path.unlink()
    if flow is not None:
        np.save(path, flow)
    told = refused(lambda: second(root).source(NAMES[0], HW))
    assert said in told
    assert path.name in told


def test_data_set_of_single_frames_is_refused(tmp_path: Path) -> None:
    root = write_data(tmp_path / "mf", {"test": list(NAMES)}, HW)
    assert "has no second frames: expected MFNet's layout" in refused(lambda: second(root))
