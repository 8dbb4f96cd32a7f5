"""Which files of a folder are frames, and which frames are trained on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.data.folder.frames import FolderFrame
from rgbt.data.folder.pattern import Pattern, in_order
from rgbt.data.folder.splits import ByShare
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


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("/rgb/{name}.png", "expected a path below dataset.root"),
        ("../{name}.png", "without '..'"),
        ("rgb//{name}.png", "doubled slashes"),
        ("", "expected a path below dataset.root"),
        ("rgb/{name.png", "expected words in braces"),
        ("rgb/{}.png", "expected words in braces"),
        ("rgb/{1}.png", "expected words in braces"),
        ("rgb/{sequence}{name}.png", "with something between"),
        ("rgb/1.png", "is one file; write {name}"),
        ("rgb/{frame}.png", "has frame but no name; write {name}"),
    ],
)
def test_invalid_patterns_are_refused(sound: Path, text: str, said: str) -> None:
    sentence = refused(lambda: folder(sound, rgb=text))
    assert sentence.startswith("dataset.rgb: ")
    assert said in sentence


def test_words_of_a_pattern(tmp_path: Path) -> None:
    for name in ("a_b_7.png", "a_b_x.jpg", "._a_b_7.png", "c.png"):
        (tmp_path / "s1" / "rgb").mkdir(parents=True, exist_ok=True)
        (tmp_path / "s1" / "rgb" / name).touch()
    (tmp_path / ".hidden" / "rgb").mkdir(parents=True)
    (tmp_path / ".hidden" / "rgb" / "a_9.png").touch()
    (tmp_path / "file").touch()
    pattern = Pattern("{sequence}/rgb/{part}_{name}.png", "dataset.rgb")
    assert pattern.words == ("sequence", "part", "name")
    (found,) = pattern.files(tmp_path)
    assert dict(found.values) == {"sequence": "s1", "part": "a_b", "name": "7"}
    assert found.path == tmp_path / "s1" / "rgb" / "a_b_7.png"
    assert pattern.path(tmp_path, found.values) == found.path


def test_a_word_that_is_there_twice(tmp_path: Path) -> None:
    for name in ("s1/s1_7.png", "s1/s2_8.png", "s2/s2_s2_9.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    found = Pattern("{sequence}/{sequence}_{name}.png", "dataset.rgb").files(tmp_path)
    assert [dict(each.values) for each in found] == [
        {"sequence": "s1", "name": "7"},
        {"sequence": "s2", "name": "s2_9"},
    ]


def test_letters_that_mean_something_elsewhere(tmp_path: Path) -> None:
    for name in ("a+b (1)/7.png", "a+b (1)/7xpng"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (found,) = Pattern("a+b (1)/{name}.png", "dataset.rgb").files(tmp_path)
    assert found.values == {"name": "7"}
    (found,) = Pattern("{sequence}/{name}.png", "dataset.rgb").files(tmp_path)
    assert found.values == {"sequence": "a+b (1)", "name": "7"}


def test_order_of_names() -> None:
    names = ["f10", "f9", "f9_2", "f009", "e100", "f"]
    assert sorted(names, key=in_order) == ["e100", "f", "f009", "f9", "f9_2", "f10"]


def test_a_pattern_that_matches_nothing(root: Path) -> None:
    assert refused(lambda: folder(root, rgb="{split}/colour/{name}.png")) == (
        f"dataset.rgb: '{{split}}/colour/{{name}}.png' matches no file in {root}: in {root}/test "
        "nothing matches 'colour', test holds ir, mask, rgb; correct the pattern or dataset.root."
    )
    assert "nothing matches '{name}.jpg', rgb holds 1.png, 2.png;" in refused(
        lambda: folder(root, rgb="{split}/rgb/{name}.jpg")
    )
    (root / "empty").mkdir()
    assert "empty holds nothing" in refused(lambda: folder(root / "empty"))
    assert refused(lambda: folder(root / "none")).startswith(
        f"dataset.root: there is no folder '{root / 'none'}'; give the one that dataset.rgb="
    )


def test_missing_partners_are_refused(root: Path) -> None:
    assert refused(lambda: folder(root, thermal="{split}/ir/{name}.tif")) == (
        "dataset.thermal: '{split}/ir/{name}.tif' matches no existing file: the first would be "
        f"{root}/test/ir/1.tif, but ir holds 1_ir.tif, 2_ir.tif; correct the pattern."
    )
    assert refused(lambda: folder(root, label="{split}/labels/{name}.png")).endswith(
        "labels holds nothing; correct the pattern."
    )
    assert "needs {scene}, which dataset.rgb='{split}/rgb/{name}.png' does not have" in refused(
        lambda: folder(root, thermal="{scene}/ir/{name}.tif")
    )
    assert refused(lambda: folder(root, label="test/mask/{name}.png")) == (
        f"dataset.label: 'test_1' and 'train_1' would share {root}/test/mask/1.png; use every word "
        "of dataset.rgb in which they differ."
    )
    assert "are JPEG files, which change values and colours; save labels as PNG" in refused(
        lambda: folder(root, label="{split}/mask/{name}.JPG")
    )
    # One that is missing among others is told where it is read.
    (root / "train" / "ir" / "2_ir.tif").unlink()
    assert refused(lambda: folder(root).read("train_2")) == (
        f"'train_2': its thermal image {root}/train/ir/2_ir.tif is missing; restore it, or use "
        "data.on_error=skip to leave the frame out."
    )


def test_two_files_of_one_name(root: Path) -> None:
    for path in ("a/b_c.png", "a_b/c.png"):
        write_png(root / path, np.zeros((*HW, 3), np.uint8))
    keys = {"thermal": "{sequence}/{name}.png", "label": None, "shares": {"train": 1.0}}
    assert refused(lambda: folder(root, rgb="{sequence}/{name}.png", **keys)) == (
        f"dataset.rgb: {root}/a/b_c.png and {root}/a_b/c.png would both be called 'a_b_c'; rename "
        "one of them."
    )


def test_folder_without_permission_is_refused(sound: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def deny(_: object) -> list[str]:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("rgbt.data.folder.pattern.os.listdir", deny)
    assert refused(lambda: folder(sound)) == (
        f"{sound} may not be listed, permission is denied; allow it (chmod a+rx)."
    )


# Splits


def test_splits_by_folder(sound: Path) -> None:
    dataset = folder(sound, folders={"train": "train", "val": "test", "test": "test"})
    assert dataset.names("val") == dataset.names("test") == ("test_1", "test_2")
    missing = folder(sound, folders={"train": "training", "test": "test"})
    assert not missing.has("train")
    assert missing.has("test")
    assert refused(lambda: missing.names("train")) == (
        "dataset.folders: split 'train' is empty, dataset.rgb='{split}/rgb/{name}.png' has no file "
        "with 'training' for {split}; it has test, train, val: name one of them in "
        "dataset.folders, {train: ...}."
    )
    for ask in (dataset.names, dataset.has):
        said = refused(lambda ask=ask: ask("tset"))
        assert said.startswith("dataset has no split 'tset'")
        assert "did you mean 'test'" in said


def test_splits_have_one_definition(sound: Path) -> None:
    lists, shares = {"train": "train.txt"}, {"train": 1.0}
    assert refused(lambda: folder(sound, lists=lists)).startswith(
        "dataset: dataset.lists and {split} in dataset.rgb both define the splits; keep one"
    )
    plain = {key: text.replace("{split}", "{part}") for key, text in PATTERNS.items()}
    assert "dataset.lists and dataset.shares both define" in refused(
        lambda: folder(sound, lists=lists, shares=shares, **plain)
    )
    assert "nothing defines the splits; write {split} in dataset.rgb" in refused(
        lambda: folder(sound, **plain)
    )
    assert "nothing defines the splits" in refused(
        lambda: folder(sound, folders={"train": "train"}, **plain)
    )
    for key in ({"shares_seed": 1}, {"block": 3}):
        assert "dataset.shares_seed and dataset.block are for dataset.shares" in refused(
            lambda key=key: folder(sound, **key)
        )


def test_lines_of_a_list(root: Path) -> None:
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
        f"dataset.lists.val: there is no list '{root}/val.txt'; write it (one name per line)."
    )


def test_bare_names_in_a_list(root: Path) -> None:
    """{name} alone will do where it is the name of one frame; 1 is that of three."""
    dataset = listed(root, "3", "1")
    assert dataset.names("train") == ("train_3", "1")
    assert refused(lambda: dataset.read("1")).startswith(
        f"folder ({root}) has no frame called '1': there is no such RGB image"
    )
    assert refused(lambda: listed(root, "frame_1 label_1", "x").names("train")) == (
        f"dataset.lists.train: none of the 2 lines of {root}/list.txt is a frame: the first is "
        "'frame_1 label_1', expected names such as 'test_1' or paths such as 'test/rgb/1.png'."
    )


def test_a_list_elsewhere(root: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("test_1\n")
    dataset = listed(root, "train_1", lists={"train": str(tmp_path / "mine.txt")})
    assert dataset.names("train") == ("test_1",)


def frames_of(*paths: str) -> dict[str, FolderFrame]:
    """Frames of {sequence}/{name}, or {camera}/{sequence}/{name}; nothing is on the disk."""
    words = ("camera", "sequence", "name")
    frames = {}
    for path in paths:
        pieces = path.split("/")
        values = dict(zip(words[-len(pieces) :], pieces, strict=True))
        name = "_".join(pieces)
        frames[name] = FolderFrame(name, values, Path(path), Path(path), None)
    return frames


def drawn(frames: dict[str, FolderFrame], **keys: Any) -> ByShare:
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
        assert rule.has(split)


def test_shares_keep_cameras_of_one_moment_together() -> None:
    sides = ("left", "right")
    frames = frames_of(*(f"{side}/s/{number}" for side in sides for number in range(1, 7)))
    rule = drawn(frames, block=4, shares={"train": 0.4, "val": 0.3, "test": 0.3})
    for split in rule.splits:
        moments = [name.rpartition("_")[2] for name in rule.names(split)]
        assert len(moments) == 4
        assert sorted(moments[:2]) == sorted(moments[2:])  # left before right


def test_shares_in_a_folder(root: Path) -> None:
    """Without the word {sequence} the whole folder is one."""
    plain = {key: text.replace("{split}", "{part}") for key, text in PATTERNS.items()}
    shares = {"train": 0.5, "val": 0.5}
    dataset = folder(root, **plain, shares=shares, block=2)
    assert [len(dataset.names(split)) for split in shares] == [4, 2]
    others = [folder(root, **plain, shares=shares, block=2, shares_seed=seed) for seed in range(8)]
    assert len({other.names("val") for other in others}) > 1
    by_part = {key: text.replace("{split}", "{sequence}") for key, text in PATTERNS.items()}
    dataset = folder(root, **by_part, shares=shares)
    assert {len(dataset.names(split)) for split in shares} == {3}


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"shares": {"train": 0.5, "val": 0.4}}, "expected shares above 0 that are 1 together"),
        ({"shares": {"train": 1.5, "val": -0.5}}, "expected shares above 0 that are 1 together"),
        ({"shares": {"train": float("nan"), "val": 1.0}}, "expected shares above 0"),
        ({}, "3 splits are to be drawn from 1 sequence(s), .* give dataset.block"),
        ({"block": 10}, "3 splits are to be drawn from 2 block(s)"),
        (
            {"block": 4, "shares": {"train": 0.9, "val": 0.05, "test": 0.05}},
            "gets no frame, as 5 units of up to 4 frames stay together",
        ),
    ],
)
def test_shares_that_cannot_be(keys: dict[str, Any], said: str) -> None:
    frames = frames_of(*(f"s/{number}" for number in range(20)))
    sentence = refused(lambda: drawn(frames, **keys))
    assert sentence.startswith("dataset.")
    for words in said.split(" .* "):
        assert words in sentence
