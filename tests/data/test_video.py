"""Videos: MVSeg's layout, and folders of numbered frames of somebody's own."""

from __future__ import annotations

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from rgbt.checks import InputError
from rgbt.data.check import check_dataset
from rgbt.data.video import MVSeg
from tests.conftest import write_png
from tests.data.video_files import HW, contents, video, write_mvseg, write_videos


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
    rgb, thermal, label = contents("d_00237")
    sample = dataset.read("d_00237")
    for found, expected in ((sample.rgb, rgb), (sample.thermal, thermal), (sample.label, label)):
        np.testing.assert_array_equal(found, expected)
    assert dataset.read("d_00236").label is None
    assert len(dataset.classes) == len(set(dataset.palette)) == 26
    assert (dataset.classes[5], dataset.palette[5]) == ("pedestrian", (255, 0, 0))
    report = check_dataset(dataset)
    assert [len(problem) for problem in report.problems if "test_day" not in problem] == []


def test_mvseg_value_255_is_ignored_or_ground(mvseg: Path) -> None:
    path = mvseg / "data" / "d" / "label" / "00237l.png"
    label = np.array([[0, 25, 255]], np.uint8).repeat(16, 1).repeat(32, 0)
    image = Image.fromarray(label, "P")  # as some of its labels are stored
    image.putpalette(list(range(256)) * 3)
    image.save(path)
    for unlabelled_is, value in (("ignored", 255), ("ground", 25)):
        found = MVSeg(str(mvseg), unlabelled_is=unlabelled_is).label("d_00237")
        assert found is not None
        np.testing.assert_array_equal(found, np.where(label == 255, value, label))


def test_mvseg_reads_the_ending_of_the_first_file(mvseg: Path) -> None:
    folder = mvseg / "data" / "d" / "visible"
    for path in folder.iterdir():
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
    dataset = MVSeg(str(mvseg))
    runs = dataset.sequences("test")
    assert ("d_09999",) in [run[-1:] for run in runs]
    write_png(mvseg / "data" / "d" / "visible" / "12v.png", np.zeros((*HW, 3), np.uint8))
    with pytest.raises(
        InputError, match=r"12v.png is no frame of MVSeg: expected a number of four"
    ):
        MVSeg(str(mvseg))


def test_mvseg_gap_begins_another_sequence_or_is_refused(mvseg: Path) -> None:
    (mvseg / "data" / "d" / "visible" / "00238v.png").unlink()
    runs = MVSeg(str(mvseg)).sequences("test")
    assert runs[:2] == (("d_00236", "d_00237"), ("d_00239",))
    with pytest.raises(InputError, match=r"video 'd' lacks frame 238, .* follow 'd_00237'; res"):
        MVSeg(str(mvseg), gaps="refuse").sequences("test")


@pytest.mark.parametrize("gone", ["visible/00239v.png", "infrared/00238i.png"])
def test_a_frame_without_its_partner_is_reported(mvseg: Path, gone: str) -> None:
    path = mvseg / "data" / "d" / gone
    path.unlink()
    kind = "RGB" if "visible" in gone else "thermal"
    found = [each for each in MVSeg(str(mvseg)).own_problems({}) if f"no {kind} image" in each]
    # Without its RGB image, the thermal image and the label are left over.
    assert len(found) == (2 if kind == "RGB" else 1)
    assert all(path.stem[:-1] in each for each in found)
    assert MVSeg(str(mvseg)).sequences("test")
    dataset = MVSeg(str(mvseg), gaps="refuse")
    assert dataset.sequences("train")
    with pytest.raises(InputError, match=f"no {kind} image.*; restore it, or set dataset.gaps"):
        dataset.sequences("test")


def test_fingerprint_covers_frames_without_a_label(mvseg: Path) -> None:
    before = MVSeg(str(mvseg)).fingerprint()
    write_png(mvseg / "data" / "d" / "infrared" / "00238i.png", np.zeros(HW, np.uint8))
    assert MVSeg(str(mvseg)).fingerprint() != before


def test_one_video_of_packed_images_without_labels(tmp_path: Path) -> None:
    for number in (9, 10, 11):
        rgb, thermal, _ = contents(str(number))
        write_png(tmp_path / "drive" / f"frame_{number}.png", np.dstack([rgb, thermal]))
    packed = "frame_{name}.png"
    dataset = video(tmp_path / "drive", rgb=packed, thermal=packed, label=None, lists=None)
    assert dataset.names("test") == dataset.sequences("test")[0] == ("9", "10", "11")
    np.testing.assert_array_equal(dataset.read("10").thermal, contents("10")[1])
    assert dataset.nights(("9",)) is None
    with pytest.raises(InputError, match="no split 'train'"):
        dataset.names("train")


def test_missing_files_of_mvseg_are_named(mvseg: Path) -> None:
    (mvseg / "data" / "d" / "infrared" / "00238i.png").unlink()
    with pytest.raises(InputError, match="'d_00238': its thermal image .*00238i.png is missing"):
        MVSeg(str(mvseg)).read("d_00238")
    shutil.rmtree(mvseg / "data" / "d")
    with pytest.raises(InputError, match=r"lists.test: video 'd' has no frames"):
        MVSeg(str(mvseg)).names("test")
    shutil.rmtree(mvseg / "data")
    with pytest.raises(InputError, match="does not hold the folder data"):
        MVSeg(str(mvseg))


def test_videos_with_mistakes_are_refused(tmp_path: Path) -> None:
    root = write_videos(tmp_path / "data")
    assert video(root).sequences("test")[0] == ("x_1", "x_2", "x_3")
    two, second, last = (root / "x" / "rgb" / f"{name}.png" for name in ("2", "02", "last"))
    shutil.copy(two, second)
    with pytest.raises(InputError, match="two frames with the number 2, 'x_0?2' and 'x_0?2'"):
        video(root)
    second.rename(last)
    with pytest.raises(InputError, match=r"the frame \S+last.png of a video has no number"):
        video(root)
    last.unlink()
    two.unlink()
    # Its other frames are two apart, those of the other video one.
    with pytest.raises(InputError, match="video 'x' lacks frame 2, which should follow 'x_1'"):
        video(root).sequences("test")
    (root / "y" / "rgb" / "10.png").unlink()
    (root / "y.txt").write_text("y")
    problems = check_dataset(video(root)).problems
    assert f"{root}/y/ir/10.png has no RGB image." in problems
    with pytest.raises(InputError, match=r"10\.png has no RGB image"):
        video(root, lists={"test": "y.txt"}).sequences("test")
    write_png(root / "x" / "ir" / "1.png", np.full(HW, 30000, np.uint16))
    with pytest.raises(InputError, match=r"got uint16 .* require dataset\.thermal_range=\[low"):
        video(root).read("x_1")
    with pytest.raises(InputError, match=r"dataset\.lists has no split 'train'; known: test"):
        video(root, lists=None).names("train")
