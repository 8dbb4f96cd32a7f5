"""The command ``rgbt check``: numbers of a split, problems, and what a split lacks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from rgbt.data.check import DatasetReport, check_dataset, main
from rgbt.data.mfnet import MFNet

ROOT = Path(__file__).resolve().parents[2]
SPLITS = {"train": ["00001D", "00002N"], "val": ["00003N", "00005D"], "test": ["00004D", "00006N"]}

Png = Callable[[Path, np.ndarray], None]


def checked(root: Path, *splits: str) -> DatasetReport:
    lists = {"splits": {split: f"{split}.txt" for split in splits}} if splits else {}
    return check_dataset(MFNet(str(root), **lists))


def run(root: Path) -> int | None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "mfnet.yaml")
    node.root = str(root)
    return main.__wrapped__(OmegaConf.create({"dataset": node}), [])


def test_check_counts_a_split(write_mfnet, png: Png) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip", "00002N"]})
    first = np.zeros((24, 32), np.uint8)
    first[0, :4] = (1, 1, 2, 255)
    second = np.zeros((24, 32), np.uint8)
    second[0, 0] = 1
    for name, label in (("00001D", first), ("00001D_flip", first), ("00002N", second)):
        png(root / "labels" / f"{name}.png", label)
    split = checked(root, "train").splits["train"]
    assert (split.names, split.read, split.mirrored) == (3, 3, 1)
    assert (split.day, split.night) == (1, 1)
    assert split.sizes == {(24, 32): 3}
    assert split.pixels[[1, 2, 9]].tolist() == [5, 2, 2]
    assert split.images[[0, 1, 2, 3, 9]].tolist() == [3, 3, 2, 0, 2]
    assert split.pixels.sum() == 3 * 24 * 32


def test_check_finds_each_problem_once(write_mfnet, expected_pair, png: Png, capsys) -> None:
    root = write_mfnet(SPLITS)
    assert run(root) == 0
    output = capsys.readouterr()
    assert "mfnet (MFNet)" in output.out
    assert "24x32 (2)" in output.out
    assert "0 problem(s), 2 note(s)" in output.out  # no lists of the test by day and at night
    names = [f"{number:05d}D" for number in range(10, 17)]
    lists = {"train": [*names, "00003N"], "val": ["00003N", "00003N", "00003N_flip"]}
    write_mfnet({**SPLITS, **lists, "test_day": ["00004D", "00002N"], "test_night": ["00004D"]})
    rgb, thermal, _ = expected_pair("x", (24, 32))
    (root / "labels" / "00011D.png").unlink()
    png(root / "images" / "00099D.png", np.dstack([rgb, thermal]))
    found = checked(root).problems
    for text in (
        "labels/00011D.png is missing",
        "split val lists '00003N' 2 times",
        "split val lists 1 mirrored copies",
        "splits train and val share 1 names; the first is '00003N'",
        "split test_day lists '00002N', which is a night image",
        "split test_night lists '00004D', which is a day image",
        "splits test_day and test_night share 1 names",
        "5 files belong to no image of a split; the first is",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 8
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_check_of_missing_and_shared_lists(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    report = checked(root)
    assert len(report.problems) == 2
    assert "expected test.txt in" in report.problems[1]
    # The parts by time of day only repeat what other lists hold.
    assert sum("test_day.txt" in note or "test_night.txt" in note for note in report.notes) == 2
    shared = MFNet(str(root), splits={"val": "train.txt", "test": "train.txt"})
    assert check_dataset(shared).problems == ()


def test_check_notes_what_a_split_lacks(write_mfnet, png: Png) -> None:
    root = write_mfnet(SPLITS)
    for split, names in SPLITS.items():
        for name in names:
            label = np.ones((24, 32), np.uint8)
            label[0] = 0 if split == "test" else 5
            label[1, 0] = 8 if name == "00001D" else 1
            png(root / "labels" / f"{name}.png", label)
    end = ", which other splits have; a score of it says nothing about them."
    assert checked(root, *SPLITS).notes == (
        "no label shows 'person', 'bike', 'curve', 'guardrail', 'color_cone'; no score says "
        "anything about it.",
        f"split train has no 'unlabeled'{end}",
        f"split val has no 'unlabeled', 'bump'{end}",
        f"split test has no 'car_stop', 'bump'{end}",
    )
    for name, time in (("00004D", "night"), ("00006N", "day")):
        (root / "test.txt").write_text(f"{name}\n")
        last = checked(root, *SPLITS).notes[-1]
        assert last.startswith(f"split test has no {time} images, 'car_stop'")


def test_names_reach_the_terminal_without_control_characters(write_mfnet, capsys) -> None:
    root = write_mfnet({**SPLITS, "train": ["00001D", "0\x1b[2J1D"]})
    (root / "labels" / "0\x1b[2J1D.png").unlink()
    assert run(root) == 1
    output = capsys.readouterr()
    assert "0?[2J1D" in output.out
    assert "\x1b[2J" not in output.out + output.err
