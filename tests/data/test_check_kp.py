from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.data.check import check_dataset, main, num_listed
from rgbt.data.kp import KP
from tests.conftest import write_png
from tests.data.kp_files import (
    HW,
    LISTS,
    NAMES,
    TEST,
    TRAIN,
    VAL,
    image_path,
    write_kp,
    write_lists,
    write_ms_uda,
)

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_lists(write_kp(tmp_path / "kp"))


def run(root: Path) -> int | None:
    node = OmegaConf.load(ROOT / "conf/dataset/kp.yaml")
    node.root = str(root)
    return main.__wrapped__(OmegaConf.create({"dataset": node}))


def test_a_sound_data_set(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = KP(str(root))
    report = check_dataset(dataset)
    assert report.problems == ()
    assert num_listed(dataset) == 9
    times = {
        split.split: (split.num_read, split.num_day, split.num_night) for split in report.splits
    }
    assert times == {
        **{"train": (3, 2, 1), "train_day": (2, 2, 0), "train_night": (1, 0, 1)},
        **{"val": (2, 1, 1), "val_day": (1, 1, 0), "val_night": (1, 0, 1)},
        **{"test": (4, 2, 2), "test_day": (2, 2, 0), "test_night": (2, 0, 2)},
    }
    assert report.notes[:2] == (
        "splits are read from the lists train.txt, val.txt, test.txt.",
        "split train has 2 day and 1 night images, the official list has 261 and 238 (499 in all).",
    )
    assert [note.partition(" has ")[0] for note in report.notes[1:-1]] == [
        "split train",
        "split val",
        "split test",
    ]
    assert report.notes[-1].startswith("images are 16x24, the original ones 512x640")
    assert run(root) == 0
    output = capsys.readouterr().out
    assert "kp (KP in the layout of the CRM release, splits from list files)" in output
    assert "0 problem(s)" in output


def test_published_numbers_are_of_kp_alone(root: Path) -> None:
    (note,) = check_dataset(KP(str(root), name="own")).notes
    assert note.startswith("splits are read from")


def test_splits_by_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_ms_uda(tmp_path)
    report = check_dataset(KP(str(root)))
    assert report.problems == ()
    assert report.notes[0].startswith("no list is read: all labels on disk are divided")
    assert run(root) == 0
    assert "kp (KP in the layout of MS-UDA, splits from set numbers)" in capsys.readouterr().out


def test_an_image_of_void_alone(root: Path) -> None:
    for name in VAL:
        write_png(root / "labels" / f"{name}.png", np.full(HW, 19, np.uint8))
    report = check_dataset(KP(str(root)))
    assert report.problems == ()
    (val,) = [split for split in report.splits if split.split == "val"]
    assert val.pixels.tolist() == [0] * 19 + [2 * HW[0] * HW[1]]
    assert val.images.tolist() == [0] * 19 + [2]


def test_division_of_ms_uda_gives_note(root: Path) -> None:
    def has_note() -> bool:
        return any("as in MS-UDA" in note for note in check_dataset(KP(str(root))).notes)

    days = [name for name in NAMES if name[:5] in ("set00", "set02", "set06", "set07", "set08")]
    nights = [name for name in NAMES if name not in days]
    assert not has_note()
    write_lists(root, {"train": days, "val": nights, "test": nights})
    assert has_note()
    # A day of CRM to train on and one of its nights to validate on is no division of MS-UDA.
    write_lists(root, {"train": TRAIN[:2], "val": VAL[1:]})
    assert not has_note()
    write_lists(root, {"train": [*days, TRAIN[2]], "val": VAL[1:]})
    assert not has_note()


def test_each_problem_is_one_line(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write_lists(
        root,
        {
            **{"train": TRAIN, "train_day": [TRAIN[0], TRAIN[2]], "train_night": TRAIN[2:]},
            **{"val": (*VAL, VAL[0]), "test": (*TEST[:3], TRAIN[1])},
        },
    )
    image_path(root, TRAIN[0], "lwir").unlink()
    write_png(root / "labels" / f"{TRAIN[1]}.png", np.full(HW, 20, np.uint8))
    write_png(root / "labels" / "00001D.png", np.zeros(HW, np.uint8))
    found = check_dataset(KP(str(root))).problems
    for text in (
        f"{image_path(root, TRAIN[0], 'lwir')} is missing",
        "label value 20 is out of range",
        f"split val lists '{VAL[0]}' 2 times.",
        f"split val_day lists '{VAL[0]}' 2 times.",
        f"splits train and test share 1 names, the first is '{TRAIN[1]}'.",
        f"splits train_day and train_night share 1 names, the first is '{TRAIN[2]}'.",
        f"split train_day lists '{TRAIN[2]}', which was recorded at night (set03).",
        "split train is not train_day and train_night together: 1 names are in one of them alone, "
        f"the first is '{TRAIN[1]}'.",
        "1 labels have names without a set, the first is '00001D.png'.",
        f"no split names 1 labels on disk, the first is '{TEST[3]}.png'.",
    ):
        assert sum(text in problem for problem in found) == 1, text
    # Day and night that are made of the lists repeat what is wrong with these.
    assert {problem for problem in found if "test_day" in problem} == {
        f"splits {split} and test_day share 1 names, the first is '{TRAIN[1]}'."
        for split in ("train",)
    }
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_splits_of_one_list_may_share_names(root: Path) -> None:
    (root / "test.txt").unlink()
    splits = {"train": "train.txt", "val": "val.txt", "val_day": "val_day.txt", "test": "val.txt"}
    report = check_dataset(KP(str(root), splits=splits))
    assert report.problems == (f"no split names 4 labels on disk, the first is '{TEST[0]}.png'.",)
    assert report.notes[0] == "splits are read from the lists train.txt, val.txt."


def test_a_split_without_nights_is_told(root: Path) -> None:
    write_lists(root, {"val": VAL[:1]})
    (root / "labels" / f"{VAL[1]}.png").unlink()
    report = check_dataset(KP(str(root)))
    assert report.problems == ()
    assert report.notes[0].startswith("split 'val_night' of kp is empty")


def test_lists_that_are_missing(root: Path) -> None:
    (root / "test.txt").unlink()
    report = check_dataset(KP(str(root)))
    assert len(report.problems) == 2
    assert report.problems[0].startswith("dataset.splits.test: there is no list")
    assert report.problems[1].startswith("no split names 4 labels on disk")
    assert set(LISTS) - {split.split for split in report.splits} == {"test"}
