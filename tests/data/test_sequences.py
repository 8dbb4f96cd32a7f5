"""Which frames follow each other."""

from __future__ import annotations

from pathlib import Path

import pytest

from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.sequences import FramesInOrder, consecutive, sequences_of_names
from tests.conftest import write_data
from tests.data.video_files import video, write_videos


def test_names_that_differ_in_their_last_number_by_one_are_a_sequence() -> None:
    names = ["00102D", "00101D", "00103D", "00101N", "00105D", "00106D", "00103D", "other"]
    assert sequences_of_names(names) == (
        ("00101D", "00102D", "00103D"),
        ("00105D", "00106D"),
        ("00101N",),
        ("other",),
    )


def test_every_fifth_frame_is_a_sequence_too() -> None:
    names = [f"seq_1_{number}" for number in (10, 5, 20, 30)] + ["seq_2_7"]
    assert sequences_of_names(names) == (
        *(("seq_1_5", "seq_1_10"), ("seq_1_20",), ("seq_1_30",), ("seq_2_7",)),
    )
    assert tuple(consecutive({1: "a", 3: "b", 4: "c"}, 1)) == (("a",), ("b", "c"))
    assert tuple(consecutive({})) == ()


def test_frames_of_a_split_in_order(tmp_path: Path) -> None:
    names = ["00003D", "00001D", "00002D", "00007D", "00001N", "00002N"]
    root = write_data(tmp_path / "data", {"test": names}, (12, 16))
    found = FramesInOrder(MFNet(str(root)), "test")
    assert found.names("test") == ("00001D", "00002D", "00003D", "00001N", "00002N")
    assert found.pairs == {"00002D": "00001D", "00003D": "00002D", "00002N": "00001N"}
    assert found.alone == 1
    assert found.read("00002D").name == "00002D"


def test_frames_of_a_video_need_no_label(tmp_path: Path) -> None:
    dataset = video(write_videos(tmp_path / "data"))
    assert dataset.names("test") == ("x_2", "y_9")
    found = FramesInOrder(dataset, "test")
    assert found.names("test") == ("x_1", "x_2", "x_3", "y_8", "y_9", "y_10")
    assert found.pairs == {"x_2": "x_1", "x_3": "x_2", "y_9": "y_8", "y_10": "y_9"}


def test_a_split_without_neighbours_is_refused(tmp_path: Path) -> None:
    root = write_data(tmp_path / "data", {"test": ["00001D"]}, (12, 16))
    with pytest.raises(InputError, match=r"no two consecutive frames among its 1 frame\(s\)"):
        FramesInOrder(MFNet(str(root)), "test")
