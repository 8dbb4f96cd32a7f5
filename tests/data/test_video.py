"""Videos: MVSeg's layout, folders of numbered frames, and which frames follow each other."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbt.data.check import check_dataset
from rgbt.data.mfnet import MFNet
from rgbt.data.video import MVSeg, consecutive, frames_before, frames_in_order, sequences_of_names
from tests.conftest import write_data, write_png
from tests.data.layouts import (
    CLASSES,
    of_mvseg,
    of_video,
    refused,
    video,
    write_mvseg,
    write_videos,
)

HW = (32, 48)


@pytest.fixture
def mvseg(tmp_path: Path) -> Path:
    return write_mvseg(tmp_path / "mvseg")


def test_mvseg_reads_labelled_frames_and_knows_all(mvseg: Path) -> None:
    dataset = MVSeg(str(mvseg))
    assert dataset.names("train") == ("a_00237", "a_00239", "b_00237", "b_00239")
    assert dataset.sequences("test")[1] == ("n_00236", "n_00237", "n_00238", "n_00239")
    assert dataset.nights(("d_00237", "n_00237")) == (False, True)
    assert dataset.nights(("a_00237",)) is None
    assert not dataset.has("test_day")
    sample = dataset.read("d_00237")
    arrays = (sample.rgb, sample.thermal, sample.label)
    for found, expected in zip(arrays, of_mvseg("d_00237"), strict=True):
        np.testing.assert_array_equal(found, expected)
    assert dataset.read("d_00236").label is None
    assert len(dataset.classes) == len(set(dataset.palette)) == 26
    assert (dataset.classes[5], dataset.palette[5]) == ("pedestrian", (255, 0, 0))
    before = dataset.fingerprint()  # of frames without a label too
    write_png(mvseg / "data" / "d" / "infrared" / "00238i.png", np.zeros(HW, np.uint8))
    assert MVSeg(str(mvseg)).fingerprint() != before


def test_mvseg_value_255_is_ignored_or_ground(mvseg: Path) -> None:
    path = mvseg / "data" / "d" / "label" / "00237l.png"
    label = np.array([[0, 25, 255]], np.uint8).repeat(16, 1).repeat(32, 0)
    image = Image.fromarray(label, "P")  # as some of its labels are stored
    image.putpalette(list(range(256)) * 3)
    image.save(path)
    for unlabelled_is, value in (("ignored", 255), ("ground", 25)):
        found = MVSeg(str(mvseg), unlabelled_is=unlabelled_is).label("d_00237")
        np.testing.assert_array_equal(found, np.where(label == 255, value, label))


def test_mvseg_reads_either_ending(mvseg: Path) -> None:
    for path in list((mvseg / "data" / "d" / "visible").iterdir()):
        image = cv2.imread(str(path))
        cv2.imwrite(str(path.with_suffix(".jpg")), np.full_like(image, 90))
        path.unlink()
    dataset = MVSeg(str(mvseg))
    assert dataset.frame("d_00237").rgb.name == "00237v.jpg"
    assert abs(int(dataset.read("d_00237").rgb.mean()) - 90) <= 1
    assert dataset.frame("d_00237").thermal.name == "00237i.png"


def test_mvseg_number_is_the_last_four_digits(mvseg: Path) -> None:
    for kind, letter in (("visible", "v"), ("infrared", "i")):
        folder = mvseg / "data" / "d" / kind
        for number in (9999, 10000):
            shutil.copy(folder / f"00236{letter}.png", folder / f"{number:05d}{letter}.png")
    assert ("d_09999",) in [run[-1:] for run in MVSeg(str(mvseg)).sequences("test")]
    write_png(mvseg / "data" / "d" / "visible" / "12v.png", np.zeros((*HW, 3), np.uint8))
    assert "12v.png is no frame of MVSeg" in refused(lambda: MVSeg(str(mvseg)))


def test_mvseg_gap_begins_another_sequence_or_is_refused(mvseg: Path) -> None:
    (mvseg / "data" / "d" / "visible" / "00238v.png").unlink()
    runs = MVSeg(str(mvseg)).sequences("test")
    assert runs[:2] == (("d_00236", "d_00237"), ("d_00239",))
    said = refused(lambda: MVSeg(str(mvseg), gaps="refuse").sequences("test"))
    assert "video 'd' lacks frame 238, which should follow 'd_00237'; restore it" in said
    shutil.rmtree(mvseg / "data" / "d")
    assert "lists.test: video 'd' has no frames" in refused(lambda: MVSeg(str(mvseg)).names("test"))


@pytest.mark.parametrize("gone", ["visible/00239v.png", "infrared/00238i.png"])
def test_a_frame_without_its_partner_is_reported(mvseg: Path, gone: str) -> None:
    path = mvseg / "data" / "d" / gone
    path.unlink()
    kind = "RGB" if "visible" in gone else "thermal"
    found = [
        problem for problem in MVSeg(str(mvseg)).own_problems({}) if f"no {kind} image" in problem
    ]
    # Without its RGB image, the thermal image and the label are left over.
    assert len(found) == (2 if kind == "RGB" else 1)
    assert all(path.stem[:-1] in problem for problem in found)
    assert MVSeg(str(mvseg)).sequences("test")
    dataset = MVSeg(str(mvseg), gaps="refuse")
    assert dataset.sequences("train")
    assert f"no {kind} image" in refused(lambda: dataset.sequences("test"))


def test_one_video_of_packed_images_without_labels(tmp_path: Path) -> None:
    for number in (9, 10, 11):
        rgb, thermal, _ = of_video(str(number))
        write_png(tmp_path / "drive" / f"frame_{number}.png", np.dstack([rgb, thermal]))
    packed = "frame_{name}.png"
    means: dict[str, Any] = {"background": CLASSES[:1], "unscored": CLASSES[1:]}
    dataset = video(tmp_path / "drive", rgb=packed, thermal=packed, label=None, lists=None, **means)
    assert {name: getattr(dataset, name) for name in means} == means
    assert dataset.names("test") == dataset.sequences("test")[0] == ("9", "10", "11")
    np.testing.assert_array_equal(dataset.read("10").thermal, of_video("10")[1])
    assert dataset.nights(("9",)) is None
    said = refused(lambda: dataset.names("train"))
    assert "dataset.lists has no split 'train'; known: test" in said


def test_videos_with_mistakes_are_refused(tmp_path: Path) -> None:
    root = write_videos(tmp_path / "data")
    two, second, last = (root / "x" / "rgb" / f"{name}.png" for name in ("2", "02", "last"))
    shutil.copy(two, second)
    assert "two frames with the number 2" in refused(lambda: video(root))
    second.rename(last)
    assert "last.png of a video has no number" in refused(lambda: video(root))
    last.unlink()
    two.unlink()
    # Its other frames are two apart, those of the other video one.
    said = refused(lambda: video(root).sequences("test"))
    assert "video 'x' lacks frame 2, which should follow 'x_1'" in said
    assert (
        f"2 times (x/ir/2.png, x/label/2.png): {root}/x/ir/2.png has no RGB image."
        in check_dataset(video(root)).problems
    )


# Sequences.


def test_names_with_consecutive_last_numbers_are_a_sequence() -> None:
    names = ["00102D", "00101D", "00103D", "00101N", "00105D", "00106D", "00103D", "other"]
    assert sequences_of_names(names) == (
        *(("00101D", "00102D", "00103D"), ("00105D", "00106D"), ("00101N",), ("other",)),
    )


def test_every_fifth_frame_is_a_sequence_too() -> None:
    names = [f"seq_1_{number}" for number in (10, 5, 20, 30)] + ["seq_2_7"]
    assert sequences_of_names(names) == (
        *(("seq_1_5", "seq_1_10"), ("seq_1_20",), ("seq_1_30",), ("seq_2_7",)),
    )
    assert tuple(consecutive({})) == ()


def test_frames_of_a_split_in_order(tmp_path: Path) -> None:
    names = ["00003D", "00001D", "00002D", "00007D", "00001N", "00002N"]
    found = frames_in_order(MFNet(str(write_data(tmp_path / "a", {"test": names}, HW))), "test")
    assert found == (("00001D", "00002D", "00003D"), ("00001N", "00002N"))
    before = frames_before(found)
    assert before == {"00002D": "00001D", "00003D": "00002D", "00002N": "00001N"}
    dataset = video(write_videos(tmp_path / "b"))  # whose frames need no label
    assert dataset.names("test") == ("x_2", "y_9")
    found = frames_in_order(dataset, "test")
    assert found == (("x_1", "x_2", "x_3"), ("y_8", "y_9", "y_10"))
    assert frames_before(found) == {"x_2": "x_1", "x_3": "x_2", "y_9": "y_8", "y_10": "y_9"}
    alone = MFNet(str(write_data(tmp_path / "c", {"test": ["00001D"]}, HW)))
    said = refused(lambda: frames_in_order(alone, "test"))
    assert "no two consecutive frames among its 1 frame(s)" in said
