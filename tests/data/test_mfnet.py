"""MFNet: its two layouts, its lists, and what the check finds in a copy."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from rgbt.checks import InputError
from rgbt.data.check import main
from rgbt.data.mfnet import MFNet
from rgbt.data.report import check_dataset

ROOT = Path(__file__).resolve().parents[2]
SHARED = Path(os.environ.get("RGBT_SHARED", ROOT.parent / "shared")) / "realdata"
SPLITS = {"train": ["00001D", "00002N"], "val": ["00003N"], "test": ["00004D"]}


def problems(root: Path, **keys) -> list[str]:
    return list(check_dataset(MFNet(str(root), **keys)).problems)


def run(root: Path, **splits: str) -> int | None:
    node = OmegaConf.load(ROOT / "conf" / "dataset" / "mfnet.yaml")
    node.root = str(root)
    OmegaConf.update(node, "splits", splits)
    return main.__wrapped__(OmegaConf.create({"dataset": node}), [])


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


def test_known_pixel(tmp_path: Path, png) -> None:
    """Channel by channel, so that neither B, G, R nor a dropped fourth channel can pass."""
    image = np.zeros((2, 3, 4), np.uint8)
    image[1, 2] = (10, 20, 30, 40)
    png(tmp_path / "images" / "00001D.png", image)
    png(tmp_path / "labels" / "00001D.png", np.full((2, 3), 8, np.uint8))
    sample = MFNet(str(tmp_path)).read("00001D")
    assert sample.rgb[1, 2].tolist() == [10, 20, 30]
    assert sample.thermal[1, 2] == 40
    assert sample.label.tolist() == [[8, 8, 8], [8, 8, 8]]


def test_layout_is_detected_or_as_configured(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]}, layout="folders")
    with pytest.raises(InputError, match=r"does not hold the folders images\+labels"):
        MFNet(str(root), layout="packed")
    rgb, thermal, _ = expected_pair("00001D", (24, 32))
    png(root / "Thermal" / "00001D.png", np.dstack([thermal] * 3))
    np.testing.assert_array_equal(MFNet(str(root)).read("00001D").thermal, thermal)
    png(root / "Thermal" / "00001D.png", np.dstack([thermal, thermal, 255 - thermal]))
    with pytest.raises(InputError, match=r"Thermal.*three equal ones, got 3 channels that differ"):
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
    with pytest.raises(InputError, match=r"dataset.splits.test: the list .*no.txt' does not exist"):
        dataset.names("test")


def test_day_and_night(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    names = ("00001D", "00001N", "00001D_flip", "00001N_flip")
    assert dataset.nights(names) == (False, True, False, True)
    assert dataset.nights(("frame7",)) is None
    with pytest.raises(InputError, match="'frame7' does not state a time of day"):
        dataset.nights((*names, "frame7"))


def test_missing_mirrored_copy_is_named(write_mfnet) -> None:
    dataset = MFNet(str(write_mfnet({"train": ["00001D"]})))
    with pytest.raises(InputError, match=r"00001D_flip.png is missing; .* mirrored copy"):
        dataset.read("00001D_flip")


def test_wrong_channels_and_bits_are_refused(write_mfnet, expected_pair, png) -> None:
    root = write_mfnet({"train": ["00001D"]})
    rgb, thermal, label = expected_pair("00001D", (24, 32))
    packed = np.dstack([rgb, thermal])
    wrong = label.copy()
    wrong[3, 4] = 9
    for folder, image, said in (
        ("images", rgb, "expected 4 channels .*, got 3"),
        ("images", packed.astype(np.uint16), "expected 8 bits per channel, got uint16"),
        ("labels", label.astype(np.uint16), "expected 8 bits"),
        ("labels", rgb, "expected one channel of class indices, got 3"),
        ("labels", wrong, "label value 9 is out of range; expected 0 to 8"),
    ):
        write_mfnet({"train": ["00001D"]})
        png(root / folder / "00001D.png", image)
        with pytest.raises(InputError, match=rf"{folder}/00001D.png: {said}"):
            MFNet(str(root)).read("00001D")


def test_check_counts_a_split(write_mfnet, png) -> None:
    root = write_mfnet({"train": ["00001D", "00001D_flip", "00002N"]})
    first = np.zeros((24, 32), np.uint8)
    first[0, :4] = (1, 1, 2, 255)
    second = np.zeros((24, 32), np.uint8)
    second[0, 0] = 1
    for name, label in (("00001D", first), ("00001D_flip", first), ("00002N", second)):
        png(root / "labels" / f"{name}.png", label)
    (split,) = check_dataset(MFNet(str(root), splits={"train": "train.txt"})).splits
    assert (split.num_names, split.num_read, split.num_flipped) == (3, 3, 1)
    assert (split.num_day, split.num_night) == (1, 1)
    assert split.sizes == {(24, 32): 3}
    assert split.pixels[[1, 2, 9]].tolist() == [5, 2, 2]
    assert split.images[[0, 1, 2, 3, 9]].tolist() == [3, 3, 2, 0, 2]
    assert split.pixels.sum() == 3 * 24 * 32


def test_check_finds_each_problem_once(write_mfnet, expected_pair, png, capsys) -> None:
    root = write_mfnet(SPLITS)
    assert run(root) == 0
    output = capsys.readouterr()
    assert "mfnet (packed layout)" in output.out
    assert "24x32 (2)" in output.out
    assert "0 problem(s)" in output.out
    assert "reading" in output.err
    names = [f"{number:05d}D" for number in range(10, 17)]
    lists = {"train": [*names, "odd", "00003N"], "val": ["00003N", "00003N", "00003N_flip"]}
    write_mfnet({**SPLITS, **lists, "test_day": ["00004D", "00002N"], "test_night": ["00004D"]})
    rgb, thermal, _ = expected_pair("x", (24, 32))
    (root / "labels" / "00011D.png").unlink()
    png(root / "images" / "00099D.png", np.dstack([rgb, thermal]))
    found = problems(root)
    for text in (
        "labels/00011D.png is missing",
        "split train: 'odd' is not five digits followed by D or N",
        "split val lists '00003N' 2 times",
        "split val lists 1 mirrored copies",
        "splits train and val share 1 names; the first is '00003N'",
        "split test_day lists '00002N', which is a night image",
        "split test_night lists '00004D', which is a day image",
        "splits test_day and test_night share 1 names",
        "3 files belong to no image of a split; the first is",
    ):
        assert sum(text in problem for problem in found) == 1, text
    assert len(found) == 9
    assert not any("\n" in problem for problem in found)
    assert run(root) == 1
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("problem: ")]
    assert lines == [f"problem: {problem}" for problem in found]


def test_check_of_missing_and_shared_lists(write_mfnet, capsys) -> None:
    root = write_mfnet({"train": ["00001D"]})
    (root / "val.txt").write_text("")
    report = check_dataset(MFNet(str(root)))
    assert len(report.problems) == 2
    assert "val.txt' is empty" in report.problems[0]
    assert "test.txt'" in report.problems[1]
    # The parts by time of day only repeat what other lists hold.
    assert sum("test_day.txt" in note or "test_night.txt" in note for note in report.notes) == 2
    (root / "val.txt").write_text("00001D\n")
    assert problems(root, splits={"val": "val.txt", "test": "val.txt"}) == []
    (root / "train.txt").unlink()
    (root / "val.txt").unlink()
    assert run(root) == 1
    assert "4 problem(s)" in capsys.readouterr().out  # three lists, and files that none names


def test_check_notes_numbers_and_sizes(write_mfnet) -> None:
    root = write_mfnet(SPLITS)
    write_mfnet({"val": ["00005N"]}, hw=(12, 16))
    report = check_dataset(MFNet(str(root)))
    assert (
        "split train has 1 day and 1 night images, but the official list has 410 and 374 (784 in "
        "total)." in report.notes
    )
    assert any("differ in size (12x16, 24x32)" in note for note in report.notes)
    own = check_dataset(MFNet(str(root), name="own"))
    assert not any("the official list" in line for line in own.notes)


def test_check_does_not_depend_on_threads(write_mfnet) -> None:
    names = [f"{number:05d}D" for number in range(12)]
    root = write_mfnet({**SPLITS, "train": names})
    for name in names[::2]:
        (root / "images" / f"{name}.png").unlink()
    counted: list[int] = []
    dataset = MFNet(str(root))
    one = check_dataset(dataset, num_threads=1, advance=lambda: counted.append(1))
    assert one.problems == check_dataset(dataset, num_threads=4).problems
    assert len(counted) == 13  # 00004D is in two lists


def test_check_of_another_class_is_refused() -> None:
    node = {"_target_": "rgbt.data.label_map.LabelMap", "num_source": 1, "targets": ["a"]}
    config = OmegaConf.create({"dataset": {**node, "groups": {"a": [0]}}})
    with pytest.raises(InputError, match="LabelMap cannot be checked"):
        main.__wrapped__(config, [])


@pytest.mark.slow
@pytest.mark.skipif(not SHARED.exists(), reason="reference material is not here")
def test_check_of_real_pairs(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(SHARED / "mfnet200", test="val.txt") == 0
    output = capsys.readouterr().out
    assert (
        "split train has 50 day and 50 night images, but the official list has 410 and 374"
        in output
    )
    guardrail = next(line for line in output.splitlines() if "guardrail" in line)
    assert "(7)" in guardrail  # in training, and absent from validation
    assert "0.000% (0)" in guardrail


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
