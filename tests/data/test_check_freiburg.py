from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.data.check import check_dataset, main, num_listed
from rgbt.data.synth.freiburg import synth_freiburg
from tests.conftest import write_png
from tests.data import freiburg_files as files
from tests.data.freiburg_files import reader, write_freiburg

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_freiburg(tmp_path / "freiburg")


def run(root: Path) -> int | None:
    node = OmegaConf.load(ROOT / "conf/dataset/freiburg.yaml")
    node.root, node.crop = str(root), list(files.CROP)
    return main.__wrapped__(OmegaConf.create({"dataset": node}))


def test_a_sound_data_set(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = reader(root)
    report = check_dataset(dataset)
    assert report.problems == ()
    assert num_listed(dataset) == 12
    numbers = {
        split.split: (split.num_read, split.num_unlabelled, split.num_day, split.num_night)
        for split in report.splits
    }
    assert numbers == {
        **{"train": (3, 0, 3, 0), "train_day": (3, 0, 3, 0), "train_night": (3, 3, 0, 3)},
        **{"val": (2, 0, 2, 0), "test": (4, 0, 2, 2)},
        **{"test_day": (2, 0, 2, 0), "test_night": (2, 0, 0, 2)},
    }
    assert all(set(split.sizes) == {(11, 18)} for split in report.splits)
    assert run(root) == 0
    output = capsys.readouterr().out
    assert "freiburg (layout of Freiburg Thermal)" in output
    assert "unlabelled" in output
    assert "0 problem(s)" in output


def test_pixels_are_counted_by_class(root: Path) -> None:
    report = check_dataset(reader(root))
    for split in report.splits:
        expected = np.zeros(15, int)
        for name in reader(root).names(split.split):
            label = files.contents("_".join(name.split("_")[-2:]))[2][1:12, 5:23].ravel()
            if split.split != "train_night":
                expected[:14] += np.bincount(label, minlength=14)
        if "train" not in split.split:
            expected[[13, 14]] = expected[[14, 13]]
        assert split.pixels.tolist() == expected.tolist()


def test_the_share_of_clipped_counts(root: Path) -> None:
    dataset = reader(root)
    counts = np.full(files.HW, 22000, np.uint16)
    # Inside the crop of 11 x 18 = 198 pixels, of three frames; and one pixel outside of it.
    counts[1, 5:23] = 0
    counts[2, 5:10] = 21799
    counts[3, 5:7] = 23701
    counts[4, 5:9] = (21800, 23700, 23700, 21800)
    counts[0, 0] = 65535
    for name in dataset.names("train_night"):
        write_png(dataset.frame(name).thermal, counts)
    report = check_dataset(dataset)
    (split,) = [each for each in report.splits if each.split == "train_night"]
    assert split.thermal == (3 * 198, 3 * 18, 3 * 5, 3 * 2, 21799, 23701)
    (note,) = [note for note in report.notes if "train_night" in note]
    assert note == (
        "split train_night: of the thermal pixels 9.09% are 0, which margins are, 2.53% lie below "
        "and 1.01% above dataset.thermal_range=[21800, 23700]; counts other than 0 run from 21799 "
        "to 23701."
    )
    assert not any("split train:" in note or "split test:" in note for note in report.notes)


def test_a_thermal_image_of_margins_alone(root: Path) -> None:
    dataset = reader(root)
    for name in dataset.names("val"):
        write_png(dataset.frame(name).thermal, np.zeros(files.HW, np.uint16))
    (split,) = [each for each in check_dataset(dataset).splits if each.split == "val"]
    assert split.thermal == (2 * 198, 2 * 198, 0, 0, 0, 0)


def test_each_problem_is_one_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = reader(root)
    train, night, val = (dataset.names(split) for split in ("train_day", "train_night", "val"))
    dataset.frame(train[0]).thermal.unlink()
    label = dataset.frame(train[1]).label
    assert label is not None
    label.unlink()
    write_png(dataset.frame(night[0]).thermal, np.zeros(files.HW, np.uint8))
    dataset.frame(night[1]).rgb.write_bytes(b"damaged")
    dataset.frame(val[0]).rgb.unlink()
    test = dataset.frame(dataset.names("test_night")[0]).label
    assert test is not None
    np.save(test, np.full(files.HW, 14))
    # A frame of training under the same stamp as one for testing; its thermal lacks the zero.
    files.write_training(root, "seq_00_day/01", "1579_009")
    found = check_dataset(reader(root)).problems
    for text in (
        f"'{train[0]}': its thermal image",
        f"'{train[1]}': its label",
        "expected a thermal image of 16 bits",
        f"{dataset.frame(night[1]).rgb} cannot be decoded",
        "label value 14 is out of range",
        "2 thermal images or labels have no RGB image and are in no split, the first is "
        f"{dataset.frame(val[0]).thermal}",
        "splits test_day and train_day share 1 frames by their time stamps, the first is "
        "'test_day_1579_0090', which is 'seq_00_day_01_1579_009'.",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 7
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_equal_stamps_in_two_parts_are_reported(root: Path) -> None:
    files.write_training(root, "seq_00_night/01", "1581_0110")
    files.write_training(root, "seq_04_day/01", "1580_0100")
    files.write_training(root, "seq_00_night/01", "1580_01000")  # ten times as many nanoseconds
    found = check_dataset(reader(root)).problems
    assert [problem.partition(" by ")[0] for problem in found] == [
        "splits test_night and train_night share 1 frames",
        "splits test_night and val share 1 frames",
    ]


def test_a_part_that_is_missing(tmp_path: Path) -> None:
    files.write_training(tmp_path, "seq_00_day/00", "1_0")
    report = check_dataset(reader(tmp_path, val_sequences=()))
    assert [problem.partition(" of ")[0] for problem in report.problems] == [
        *("split 'train_night'", "split 'val'", "split 'test_day'", "split 'test_night'"),
    ]
    assert [note.partition(" of ")[0] for note in report.notes] == [
        *("split 'test'", "split train_day:"),
    ]
    assert len(report.splits) == 2


def test_the_embedded_data_set_is_sound(tmp_path: Path) -> None:
    numbers = {"num_train_day": 4, "num_train_night": 3, "num_val": 1, "num_test": 2}
    report = check_dataset(synth_freiburg(cache_dir=str(tmp_path), **numbers))
    assert report.problems == ()
    assert [note.partition(":")[0] for note in report.notes] == [
        f"split {split}" for split in ("train_day", "train_night", "val", "test_day", "test_night")
    ]


def test_data_set_without_checks_is_refused(root: Path) -> None:
    with pytest.raises(InputError, match="object cannot be checked, .* choose dataset=mfnet"):
        check_dataset(object())  # type: ignore[arg-type]
