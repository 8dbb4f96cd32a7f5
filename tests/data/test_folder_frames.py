"""Which files of a folder are frames, and which frames are trained on."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.data.patterns import Frame, Pattern, in_order
from rgbt.data.splits import ByShare
from tests.conftest import write_png
from tests.data.folder_files import (
    HW,
    PATTERNS,
    folder,
    listed,
    refused,
    write_folder,
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return write_folder(tmp_path / "mine")


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same for tests that write nothing."""
    return write_folder(tmp_path_factory.mktemp("sound") / "mine")


# Patterns


PLAIN = {key: text.replace("{split}", "{part}") for key, text in PATTERNS.items()}


def test_words_of_a_pattern(tmp_path: Path) -> None:
    for name in ("a_b_7.png", "a_b_x.jpg", "._a_b_7.png", "c.png"):
        (tmp_path / "s1" / "rgb").mkdir(parents=True, exist_ok=True)
        (tmp_path / "s1" / "rgb" / name).touch()
    (tmp_path / ".hidden" / "rgb").mkdir(parents=True)
    (tmp_path / ".hidden" / "rgb" / "a_9.png").touch()
    for name in ("x+y (1)/s1_7.png", "x+y (1)/x+y (1)_8.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    pattern = Pattern("{sequence}/rgb/{part}_{name}.png", "dataset.rgb")
    assert pattern.words == ("sequence", "part", "name")
    (found,) = pattern.files(tmp_path)
    assert dict(found.values) == {"sequence": "s1", "part": "a_b", "name": "7"}
    assert found.path == tmp_path / "s1" / "rgb" / "a_b_7.png"
    assert pattern.path(tmp_path, found.values) == found.path
    # A word that occurs twice; letters with a meaning in expressions.
    for text in ("{sequence}/{sequence}_{name}.png", "x+y (1)/x+y (1)_{name}.png"):
        (found,) = Pattern(text, "dataset.rgb").files(tmp_path)
        assert found.values["name"] == "8"


def test_order_of_names() -> None:
    names = ["f10", "f9", "f9_2", "f009", "e100", "f"]
    assert sorted(names, key=in_order) == ["e100", "f", "f009", "f9", "f9_2", "f10"]


# Splits


def test_lines_of_a_list(root: Path, tmp_path: Path) -> None:
    """The name, its words, the path of the image, each with or without suffix; in this order."""
    lines = ("test_2", "train/3", "train/rgb/1.png", "val/rgb/1", "train_2.png", "test/1.png")
    dataset = listed(root, *lines)
    assert dataset.names("train") == (
        *("test_2", "train_3", "train_1", "val_1", "train_2", "test_1"),
    )
    assert dataset.splits == {"train": "list.txt", "val": "val.txt"}
    assert dataset.has("train")
    assert not dataset.has("val")
    assert refused(lambda: dataset.names("val")) == (
        f"split 'val' of folder is empty: expected val.txt in {root}."
    )
    (tmp_path / "mine.txt").write_text("test_1\n")
    dataset = listed(root, "train_1", lists={"train": str(tmp_path / "mine.txt")})
    assert dataset.names("train") == ("test_1",)


def test_bare_names_in_a_list(root: Path) -> None:
    """{name} alone will do where it is the name of one frame; 1 is that of three."""
    dataset = listed(root, "3", "1")
    assert dataset.names("train") == ("train_3", "1")
    assert refused(lambda: dataset.read("1")).startswith(
        f"folder ({root}) has no frame called '1': there is no such RGB image"
    )
    assert refused(lambda: listed(root, "frame_1 label_1", "x").names("train")) == (
        f"dataset.lists.train: none of the 2 lines of {root}/list.txt is a frame. The first is "
        "'frame_1 label_1'; expected names such as 'test_1'."
    )


def frames_of(*paths: str) -> dict[str, Frame]:
    """Frames of {sequence}/{name}, or {camera}/{sequence}/{name}; nothing is on the disk."""
    words = ("camera", "sequence", "name")
    frames = {}
    for path in paths:
        pieces = path.split("/")
        values = dict(zip(words[-len(pieces) :], pieces, strict=True))
        name = "_".join(pieces)
        frames[name] = Frame(name, values, Path(path), Path(path), None)
    return frames


def drawn(frames: dict[str, Frame], **keys: Any) -> ByShare:
    shares = {"train": 0.5, "val": 0.25, "test": 0.25}
    return ByShare(frames, **{"shares": shares, "seed": 0, "block": None, **keys})


def test_shares_of_sequences() -> None:
    frames = frames_of(*(f"s{index}/{number}" for index in range(8) for number in range(3)))
    rule = drawn(frames)
    parts = {split: rule.names(split) for split in rule.splits}
    assert [len(parts[split]) for split in ("train", "val", "test")] == [12, 6, 6]
    assert sorted(sum(parts.values(), ())) == sorted(frames)
    sequences = [{name.split("_")[0] for name in names} for names in parts.values()]
    assert sum(map(len, sequences)) == len(set.union(*sequences)) == 8
    assert rule.splits["val"] == "0.25 of the frames"
    assert {split: drawn(frames).names(split) for split in rule.splits} == parts
    assert len({drawn(frames, seed=seed).names("val") for seed in range(6)}) > 1


def test_shares_of_blocks() -> None:
    rule = drawn(frames_of(*(f"s/{number}" for number in range(22))), block=5)
    blocks = [
        {f"s_{number}" for number in range(start, min(start + 5, 22))} for start in range(0, 22, 5)
    ]
    for split in ("train", "val", "test"):
        names = set(rule.names(split))
        assert names == set().union(*(block for block in blocks if block & names))
        assert list(rule.names(split)) == sorted(names, key=in_order)


def test_shares_keep_cameras_of_one_moment_together() -> None:
    sides = ("left", "right")
    frames = frames_of(*(f"{side}/s/{number}" for side in sides for number in range(1, 7)))
    rule = drawn(frames, block=4, shares={"train": 0.4, "val": 0.3, "test": 0.3})
    for split in rule.splits:
        moments = [name.rpartition("_")[2] for name in rule.names(split)]
        assert len(moments) == 4
        assert sorted(moments[:2]) == sorted(moments[2:])  # left before right


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"rgb": "/rgb/{name}.png"}, "dataset.rgb: expected a path below dataset.root"),
        ({"rgb": "../{name}.png"}, "dataset.rgb: expected a path below"),
        ({"rgb": "rgb//{name}.png"}, "dataset.rgb: expected a path below"),
        ({"rgb": "rgb/{name.png"}, "dataset.rgb: expected a path below dataset.root with words"),
        ({"rgb": "rgb/{}.png"}, "dataset.rgb: expected"),
        ({"rgb": "rgb/{sequence}{name}.png"}, "dataset.rgb: .* other text between them"),
        ({"rgb": "rgb/1.png"}, "dataset.rgb: expected"),
        ({"rgb": "rgb/{frame}.png"}, "dataset.rgb: .* has no {name}"),
        ({"rgb": "{split}/rgb/{name}.jpg"}, "matches no file in .*, which holds test, train, val"),
        ({"thermal": "{split}/ir/{name}.tif"}, "dataset.thermal: .* but ir holds 1_ir.tif, 2_ir"),
        ({"thermal": "{scene}/ir/{name}.tif"}, "dataset.thermal: .* 'scene' is not a valid choice"),
        ({"label": "{split}/labels/{name}.png"}, "dataset.label: .*labels holds nothing"),
        ({"label": "test/mask/{name}.png"}, "several frames would share .*test/mask/1.png"),
        ({"lists": {"train": "a.txt"}}, "got {split} in dataset.rgb and dataset.lists"),
        (
            {"lists": {"train": "a.txt"}, "shares": {"train": 1.0}, **PLAIN},
            "got dataset.lists and dataset.shares",
        ),
        (PLAIN, "must define the splits, got none"),
        ({"folders": {"train": "train"}, **PLAIN}, "exactly one of .* must define the splits"),
        ({"shares_seed": 1}, "dataset.shares_seed and dataset.block require dataset.shares"),
        ({"shares": {"train": 0.5, "val": 0.4}, **PLAIN}, "dataset.shares: expected shares above"),
        ({"shares": {"train": 1.5, "val": -0.5}, **PLAIN}, "dataset.shares: expected shares above"),
        ({"shares": {"train": 0.5, "val": 0.5}, **PLAIN}, "split 'val' gets no frame"),
        (
            {"shares": {"train": 0.9, "val": 0.1}, "block": 5, **PLAIN},
            "split 'val' gets no frame, .* in 2 unit",
        ),
    ],
)
def test_wrong_descriptions_are_refused(sound: Path, keys: dict[str, Any], said: str) -> None:
    sentence = refused(lambda: folder(sound, **keys))
    assert re.search(said.replace("{", r"\{"), sentence), sentence


def test_two_files_of_one_name_and_a_folder_without_permission(
    root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for path in ("a/b_c.png", "a_b/c.png"):
        write_png(root / path, np.zeros((*HW, 3), np.uint8))
    keys = {"thermal": "{sequence}/{name}.png", "label": None, "shares": {"train": 1.0}}
    assert refused(lambda: folder(root, rgb="{sequence}/{name}.png", **keys)) == (
        f"dataset.rgb: {root}/a/b_c.png and {root}/a_b/c.png would both be called 'a_b_c'; rename "
        "one of them."
    )
    closed = root / "val" / "rgb"
    monkeypatch.setattr("rgbt.data.patterns.os.access", lambda path, mode: path != closed)
    assert refused(lambda: folder(root)).startswith(f"{closed} cannot be listed: permission denied")


def test_splits_by_folder_and_by_shares_of_a_folder(sound: Path) -> None:
    dataset = folder(sound, folders={"train": "train", "val": "test", "test": "test"})
    assert dataset.names("val") == dataset.names("test") == ("test_1", "test_2")
    missing = folder(sound, folders={"train": "training", "test": "test"})
    assert not missing.has("train")
    assert missing.has("test")
    assert "expected training/rgb/{name}.png in" in refused(lambda: missing.names("train"))
    # Without the word {sequence} the whole folder is one.
    shares = {"train": 0.5, "val": 0.5}
    drawn = [folder(sound, **PLAIN, shares=shares, block=2, shares_seed=n) for n in range(8)]
    assert {len(each.names("train")) for each in drawn} == {4}
    assert len({each.names("val") for each in drawn}) > 1
    by_part = {key: text.replace("{split}", "{sequence}") for key, text in PATTERNS.items()}
    dataset = folder(sound, **by_part, shares=shares)
    assert {len(dataset.names(split)) for split in shares} == {3}
