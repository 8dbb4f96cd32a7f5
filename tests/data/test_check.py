from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.data.check import check_dataset, main, num_listed, print_report
from rgbt.data.mfnet import MFNet

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared"))
REAL = SHARED / "realdata" / "mfnet200"

SPLITS = {"train": ["00001D", "00002N"], "val": ["00003N"], "test": ["00004D"]}


def problems(root: Path, **keys) -> list[str]:
    return list(check_dataset(MFNet(str(root), **keys)).problems)


def run(root: Path, **keys) -> int | None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "mfnet.yaml")
    node.root = str(root)
    OmegaConf.update(node, "splits", keys.get("splits", {}))
    return main.__wrapped__(OmegaConf.create({"dataset": node}))


def test_a_sound_data_set(write_mfnet, capsys: pytest.CaptureFixture[str]) -> None:
    root = write_mfnet(SPLITS)
    report = check_dataset(MFNet(str(root)))
    assert report.problems == ()
    assert run(root) == 0
    output = capsys.readouterr()
    assert "0 problem(s)" in output.out
    assert "24x32 (2)" in output.out
    assert "reading" in output.err


def test_numbers_of_a_split(write_mfnet, png) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip", "00002N"]})
    first = np.zeros((24, 32), np.uint8)
    first[0, :4] = (1, 1, 2, 255)
    second = np.zeros((24, 32), np.uint8)
    second[0, 0] = 1
    png(root / "labels" / "00001D.png", first)
    png(root / "labels" / "00001D_flip.png", first)
    png(root / "labels" / "00002N.png", second)
    report = check_dataset(MFNet(str(root), splits={"train": "train.txt"}))
    (split,) = report.splits
    assert (split.num_names, split.num_read, split.num_flipped) == (3, 3, 1)
    assert (split.num_day, split.num_night) == (1, 1)
    assert split.sizes == {(24, 32): 3}
    assert split.pixels[[1, 2, 9]].tolist() == [5, 2, 2]
    assert split.images[[0, 1, 2, 3, 9]].tolist() == [3, 3, 2, 0, 2]
    assert split.pixels.sum() == 3 * 24 * 32


def test_each_problem_is_one_line(write_mfnet, expected_pair, png, capsys) -> None:
    names = [f"{number:05d}D" for number in range(10, 17)]
    root = write_mfnet({**SPLITS, "train": [*names, "odd", "00003N"], "val": ["00003N", "00003N"]})
    images, labels = root / "images", root / "labels"
    rgb, thermal, label = expected_pair("x", (24, 32))
    (images / "00010D.png").unlink()
    (labels / "00011D.png").unlink()
    (images / "00012D.png").write_bytes(b"damaged")
    png(labels / "00013D.png", np.full((24, 32), 9, np.uint8))
    png(labels / "00014D.png", label[:12])
    png(images / "00015D.png", rgb)
    png(images / "00099D.png", np.dstack([rgb, thermal]))
    found = problems(root)
    for text in (
        "images/00010D.png is missing",
        "labels/00011D.png is missing",
        "images/00012D.png cannot be decoded",
        "labels/00013D.png: label value 9 is out of range",
        "'00014D': RGB is 24x32 pixels but its label is 12x32",
        "images/00015D.png: expected 4 channels",
        "split train: 'odd' is not five digits and D or N",
        "split val lists '00003N' 2 times",
        "splits train and val share 1 names, the first is '00003N'",
        "no list names 1 files on disk, the first is '00099D.png'",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 10
    assert not any("\n" in problem for problem in found)
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_lists_that_are_missing_or_empty(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    (root / "val.txt").write_text("")
    report = check_dataset(MFNet(str(root)))
    assert ["val.txt' is empty" in line or "test.txt'" in line for line in report.problems] == [
        True,
        True,
    ]
    # The parts by time of day are told, but they only repeat what other lists hold.
    told = [line for line in report.notes if "test_day.txt" in line or "test_night.txt" in line]
    assert len(told) == 2


def test_parts_and_shared_lists_do_not_overlap(write_mfnet) -> None:
    root = write_mfnet({**SPLITS, "test": ["00004D", "00005N"]})
    write_mfnet({"test_day": ["00004D"], "test_night": ["00005N"]})
    assert problems(root) == []
    splits = {"train": "train.txt", "val": "val.txt", "test": "val.txt"}
    (root / "val.txt").write_text("00003N\n00004D\n00005N\n")
    assert problems(root, splits=splits) == []


def test_time_of_day_lists(write_mfnet) -> None:
    root = write_mfnet({**SPLITS, "test_day": ["00004D", "00003N"], "test_night": ["00004D"]})
    found = problems(root)
    assert "split test_day lists '00003N', which is a N image." in found
    assert "split test_night lists '00004D', which is a D image." in found
    assert any("splits test_day and test_night share 1 names" in problem for problem in found)


def test_mirrored_copies_only_in_training(write_mfnet) -> None:
    root = write_mfnet({**SPLITS, "val": ["00003N", "00003N_flip"]})
    assert any("split val lists 1 mirrored copies" in problem for problem in problems(root))


def test_other_numbers_than_official_give_note(write_mfnet) -> None:
    root = write_mfnet(SPLITS)
    notes = check_dataset(MFNet(str(root))).notes
    assert (
        "split train has 1 day and 1 night images, the official list has 410 and 374 (784 in all)."
        in notes
    )
    own = check_dataset(MFNet(str(root), name="own"))
    assert not any("the official list" in line for line in own.notes)


def test_sizes_that_differ_are_a_note(write_mfnet) -> None:
    root = write_mfnet({"train": ["00001D"]})
    write_mfnet({"val": ["00002N"], "test": ["00003D"]}, hw=(12, 16))
    report = check_dataset(MFNet(str(root)))
    assert report.problems == ()
    assert any("differ in size (12x16, 24x32)" in line for line in report.notes)


def test_result_does_not_depend_on_threads(write_mfnet) -> None:
    names = [f"{number:05d}D" for number in range(12)]
    root = write_mfnet({**SPLITS, "train": names})
    for name in names[::2]:
        (root / "images" / f"{name}.png").unlink()
    dataset = MFNet(str(root))
    counted: list[int] = []
    one = check_dataset(dataset, num_threads=1, advance=lambda: counted.append(1))
    other = check_dataset(dataset, num_threads=4)
    assert one.problems == other.problems
    assert len(counted) == num_listed(dataset) == 13  # 00004D is in two lists


def test_nothing_can_be_read(write_mfnet, capsys) -> None:
    root = write_mfnet(SPLITS)
    for split in SPLITS:
        (root / f"{split}.txt").unlink()
    dataset = MFNet(str(root))
    report = check_dataset(dataset)
    assert len(report.problems) == 4  # three lists, and files that none names
    print_report(dataset, report)
    assert "4 problem(s)" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.skipif(not REAL.exists(), reason="reference material is not here")
def test_real_subset_passes(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(REAL, splits={"test": "val.txt"}) == 0
    output = capsys.readouterr().out
    assert "split train has 50 day and 50 night images, the official list has 410 and 374" in output
    guardrail = next(line for line in output.splitlines() if "guardrail" in line)
    assert "(7)" in guardrail  # in training, and absent from validation
    assert "0.000% (0)" in guardrail
