from __future__ import annotations

import fcntl
import json
import os
import shutil
import stat
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.kp import KP
from rgbt.data.kp_names import SPLITS
from rgbt.data.mfnet import MFNet
from rgbt.data.prepare import __main__ as prepare
from rgbt.data.prepare import copying as prepare_copy
from rgbt.data.prepare.__main__ import entry
from rgbt.data.prepare.kp import plan_kp
from rgbt.data.prepare.plans import Given
from rgbt.data.prepare.source import Entry, Source
from rgbt.data.pst900 import PST900
from tests.conftest import write_data, write_png
from tests.data import freiburg_files, kp_files, pst900_files

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).parents[3] / "shared"))
MF = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["01402D", "01189N", "01403D"]}


def call(dataset: str, source: Path, out: Path, **others: Path | str) -> int:
    """The command; its exit code."""
    words = {"dataset": dataset, "source": source, "out": out, **others}
    return entry.run([f"{key}={value}" for key, value in words.items()]) or 0


def files_in(root: Path) -> list[str]:
    """What a folder holds but for the note of the command."""
    paths = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    return sorted(path for path in paths if path != prepare_copy.PLAN)


def zipped(folder: Path, archive: Path, top: str = "") -> Path:
    """The contents of `folder` in an archive, below a folder `top` in it."""
    archive.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(archive, "w") as writer:
        for path in sorted(folder.rglob("*")):
            writer.write(path, Path(top) / path.relative_to(folder))
    return archive


def state(root: Path) -> dict[str, tuple[int, bytes]]:
    return {p: ((root / p).stat().st_mtime_ns, (root / p).read_bytes()) for p in files_in(root)}


@pytest.fixture
def mfnet(tmp_path: Path) -> Path:
    """As MFNet is downloaded, with what belongs to no list."""
    (tmp_path / "in").mkdir()
    root = write_data(tmp_path / "in" / "ir_seg_dataset", MF, (6, 8))
    (root / "make_flip.py").write_text("pass\n")
    write_png(root / "images" / "09999D.png", np.zeros((6, 8, 4), np.uint8))
    return root


MF_OUT = sorted(
    [
        f"{kind}/{name}.png"
        for names in MF.values()
        for name in names
        for kind in ("images", "labels")
    ]
    + [f"{split}.txt" for split in (*MF, "test_day", "test_night")]
)


@pytest.mark.parametrize("form", ["zip", "folder", "above", "zip below"])
def test_mfnet(mfnet: Path, tmp_path: Path, form: str) -> None:
    source = {"folder": mfnet, "above": mfnet.parent}.get(form)
    if source is None:
        archive = zipped(mfnet, tmp_path / "down" / "ir_seg_dataset.zip", "ir_seg_dataset")
        source = archive if form == "zip" else archive.parent
    before = state(mfnet)
    out = tmp_path / "out"
    assert call("mfnet", source, out) == 0
    assert state(mfnet) == before
    assert files_in(out) == MF_OUT
    made, given = MFNet(str(out)), MFNet(str(mfnet))
    for name in MF["test"]:
        np.testing.assert_array_equal(made.read(name).rgb, given.read(name).rgb)
    assert made.names("test_day") == ("01402D", "01403D")
    assert made.names("test_night") == ("01189N",)
    assert not any(path.is_symlink() for path in out.rglob("*"))


def test_mfnet_in_three_folders(tmp_path: Path) -> None:
    root = write_data(tmp_path / "MFNet", MF, (6, 8), layout="folders")
    (root / "test_day.txt").write_text("01402D\n")
    assert call("mfnet", root, tmp_path / "out") == 0
    assert MFNet(str(tmp_path / "out")).layout == "folders"
    found = files_in(tmp_path / "out")
    assert "test_day.txt" in found
    assert "test_night.txt" not in found, "who wrote one list decided about the other"
    assert (tmp_path / "out" / "test_day.txt").read_text() == "01402D\n"


def test_mirrored_copies_are_kept_where_a_list_names_them(tmp_path: Path) -> None:
    names = {**MF, "train": [*MF["train"], "00001D_flip", "00002N_flip"]}
    root = write_data(tmp_path / "in", names, (6, 8))
    assert call("mfnet", root, tmp_path / "out") == 0
    assert "images/00001D_flip.png" in files_in(tmp_path / "out")
    lists = write_data(tmp_path / "lists", {"train": MF["train"]}, (6, 8))
    assert call("mfnet", root, tmp_path / "less", lists=lists) == 1, "no list for val and test"
    assert files_in(tmp_path / "less") == sorted(
        ["train.txt"] + [f"{kind}/{n}.png" for kind in ("images", "labels") for n in MF["train"]]
    )


def test_mfnet_that_is_not_complete(mfnet: Path, tmp_path: Path) -> None:
    (mfnet / "labels" / "00003D.png").unlink()
    (mfnet / "images" / "00002N.png").unlink()
    with pytest.raises(
        InputError, match=r"2 files that lists name .* images/00002N.png, of .*train"
    ):
        call("mfnet", mfnet, tmp_path / "out")
    assert not (tmp_path / "out").exists(), "nothing is begun"
    for split in MF:
        (mfnet / f"{split}.txt").unlink()
    with pytest.raises(InputError, match=r"source: there is none of train\.txt, .*lists=\.\.\."):
        call("mfnet", mfnet, tmp_path / "out")


def test_a_list_cannot_reach_out_of_the_download(mfnet: Path, tmp_path: Path) -> None:
    write_png(tmp_path / "in" / "images" / "x.png", np.zeros((6, 8, 4), np.uint8))
    (mfnet / "train.txt").write_text("../../images/x\n")
    with pytest.raises(InputError, match="2 files that lists name are not in"):
        call("mfnet", mfnet, tmp_path / "out")


def test_which_of_several(mfnet: Path, tmp_path: Path) -> None:
    shutil.copytree(mfnet, mfnet.parent / "copy")
    with pytest.raises(InputError, match=r"several times \(copy/, ir_seg_dataset/\)"):
        call("mfnet", mfnet.parent, tmp_path / "out")
    deep = tmp_path / "a" / "b" / "c" / "d"
    shutil.move(mfnet, deep)
    assert call("mfnet", tmp_path / "a", tmp_path / "out") == 0
    with pytest.raises(InputError, match=r"does not hold the folders train/rgb or test/rgb"):
        call("pst900", tmp_path / "a", tmp_path / "other")


@pytest.mark.parametrize("form", ["zip", "folder", "above"])
def test_pst900(tmp_path: Path, form: str) -> None:
    root = pst900_files.write_pst900(tmp_path / "in" / "PST900_RGBT_Dataset")
    source = {"folder": root, "above": root.parent}.get(form)
    source = source or zipped(root, tmp_path / "PST900_RGBT_Dataset.zip", "PST900_RGBT_Dataset")
    out = tmp_path / "out"
    assert call("pst900", source, out) == 0
    parts = {"train": pst900_files.TRAIN, "test": pst900_files.TEST}
    assert files_in(out) == sorted(
        f"{part}/{kind}/{name}.png"
        for part, names in parts.items()
        for name in names
        for kind in ("rgb", "thermal", "labels")
    )
    name = pst900_files.TEST[0]
    np.testing.assert_array_equal(PST900(str(out)).read(name).rgb, pst900_files.contents(name)[0])


def kaist(root: Path, *, below: str = "") -> tuple[Path, Path]:
    """KAIST with more frames than are labelled, and the labels, apart."""
    made = kp_files.write_kp(root / "made")
    folder = root / "KAIST" / below
    folder.parent.mkdir(parents=True, exist_ok=True)
    shutil.move(made / "images", folder)
    for kind in ("visible", "lwir"):
        video = folder / "set00" / "V000" / kind
        shutil.copy(video / "I00050.jpg", video / "I00051.jpg")
    shutil.move(made / "labels", root / "labels")
    return root / "KAIST", root / "labels"


KP_OUT = sorted(
    [f"labels/{name}.png" for name in kp_files.NAMES]
    + [
        f"images/{name[:5]}/{name[6:10]}/{kind}/{name[11:]}.jpg"
        for name in kp_files.NAMES
        for kind in ("visible", "lwir")
    ]
    + list(SPLITS.values())
)


@pytest.mark.parametrize("below", ["", "images", "a/kaist-cvpr15/images"])
def test_kp_from_kaist(tmp_path: Path, below: str) -> None:
    source, labels = kaist(tmp_path, below=below)
    out = tmp_path / "out"
    assert call("kp", source, out, labels=labels) == 0
    assert files_in(out) == KP_OUT, "the labelled frames and no other"
    dataset = KP(str(out))
    assert dataset.lists == "files"
    assert dataset.names("train") == kp_files.TRAIN
    assert dataset.names("val_night") == ("set10_V001_I00130",)
    assert dataset.names("test_day") == ("set07_V000_I00050", "set08_V002_I02488")
    assert (out / "val.txt").read_text() == "set06_V000_I00253.png\nset10_V001_I00130.png\n"
    name = kp_files.TRAIN[0]
    folder = tmp_path / "KAIST" / below / "set00" / "V000"
    expected = cv2.imread(str(folder / "visible" / "I00050.jpg"))[..., ::-1]
    np.testing.assert_array_equal(dataset.read(name).rgb, expected)


def test_kp_from_archives_by_set(tmp_path: Path) -> None:
    source, labels = kaist(tmp_path)
    for number, folder in enumerate(sorted(source.iterdir())):
        # Some archives hold their folder and some its contents.
        zipped(folder, source / f"{folder.name}.zip", folder.name if number % 2 else "")
        shutil.rmtree(folder)
    archive = zipped(labels, tmp_path / "labels.zip")
    assert call("kp", source, tmp_path / "out", labels=archive) == 0
    assert files_in(tmp_path / "out") == KP_OUT


@pytest.mark.parametrize("given", ["labels", "together"])
def test_kp_as_ms_uda_has_it(tmp_path: Path, given: str) -> None:
    root = kp_files.write_ms_uda(tmp_path / "ms")
    # Labels of a network, of the same frames and of others.
    shutil.copytree(root / "labels" / "val_day", root / "labels" / "day")
    write_png(root / "labels" / "day" / "set00_V000_I00099.png", np.zeros((16, 24), np.uint8))
    others = {"labels": root / "labels"} if given == "labels" else {}
    source = root / "pseudo_KP" if given == "labels" else root
    assert call("kp", source, tmp_path / "out", **others) == 0
    dataset = KP(str(tmp_path / "out"))
    assert sorted(dataset.names("train") + dataset.names("val") + dataset.names("test")) == sorted(
        kp_files.NAMES
    )
    for name in kp_files.NAMES:
        rgb, thermal, label = kp_files.contents(name)
        sample = dataset.read(name)
        np.testing.assert_array_equal(sample.rgb, rgb)
        np.testing.assert_array_equal(sample.thermal, thermal)
        np.testing.assert_array_equal(sample.label, np.where(label == 19, 255, label))


def test_kp_with_lists_of_ones_own(tmp_path: Path) -> None:
    source, labels = kaist(tmp_path)
    (tmp_path / "lists").mkdir()
    lists = kp_files.write_lists(tmp_path / "lists", {"train": kp_files.VAL, "test": kp_files.TEST})
    call("kp", source, tmp_path / "out", labels=labels, lists=lists)
    found = files_in(tmp_path / "out")
    assert [path for path in found if path.endswith(".txt")] == ["test.txt", "train.txt"]
    assert KP(str(tmp_path / "out")).names("train") == kp_files.VAL
    assert f"labels/{kp_files.TRAIN[0]}.png" not in found
    (lists / "train.txt").write_text("set00_V000_I00051.png\n")
    with pytest.raises(InputError, match=r"lists: 1 names have no label in .*set00_V000_I00051"):
        call("kp", source, tmp_path / "b", labels=labels, lists=lists)
    (lists / "train.txt").write_text("nonsense\n")
    with pytest.raises(InputError, match=r"lists: 'nonsense' in .*train\.txt is not a name"):
        call("kp", source, tmp_path / "b", labels=labels, lists=lists)
    with pytest.raises(InputError, match=r"lists: there is none of train\.txt"):
        call("kp", source, tmp_path / "b", labels=labels, lists=source)


def test_kp_that_is_not_complete(tmp_path: Path) -> None:
    source, labels = kaist(tmp_path)
    with pytest.raises(InputError, match=r"source: there is no label such as .*labels=\.\.\."):
        call("kp", source, tmp_path / "out")
    shutil.rmtree(source / "set03")
    (source / "set06" / "V000" / "lwir" / "I00253.jpg").unlink()
    with pytest.raises(InputError, match=r"3 of the 18 images .* first is set03/V001/visible/I0"):
        call("kp", source, tmp_path / "out", labels=labels)
    write_png(labels / "set12_V000_I00001.png", np.zeros((2, 2), np.uint8))
    with pytest.raises(InputError, match=r"set12_V000_I00001.png is not a name such as"):
        call("kp", source, tmp_path / "out", labels=labels)
    (labels / "set12_V000_I00001.png").unlink()
    shutil.copytree(labels, labels / "copy")
    with pytest.raises(InputError, match=r"copy/set00.* and .* would both be set00_V000_I00050"):
        call("kp", source, tmp_path / "out", labels=labels)
    assert not (tmp_path / "out").exists()


def test_lists_of_kp_are_those_of_the_release(tmp_path: Path) -> None:
    published = SHARED / "realdata" / "kp_names"
    if not published.is_dir():
        pytest.skip("published lists are not part of the repository")
    names = [
        n[:-4]
        for s in ("train", "val", "test")
        for n in (published / f"{s}.txt").read_text().split()
    ]
    assert len(names) == 950
    source = Source.__new__(Source)
    source.path, source.key = tmp_path, "source"
    paths = [f"labels/{name}.png" for name in names]
    paths += [
        f"{name[:5]}/{name[6:10]}/{kind}/{name[11:]}.jpg"
        for name in names
        for kind in ("visible", "lwir")
    ]
    source.entries = {path: Entry(path, 1, tmp_path / path) for path in paths}
    items = {item.target: item.content for item in plan_kp(Given(source))}
    assert len(items) == 3 * 950 + 9
    for path in sorted(published.glob("*.txt")):
        assert items[path.name].split() == path.read_bytes().split()
    assert sum(target.endswith(".txt") for target in items) == len(list(published.glob("*.txt")))


@pytest.mark.parametrize("form", ["zips", "zips without a folder in them", "folders"])
def test_freiburg(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, form: str) -> None:
    root = freiburg_files.write_freiburg(tmp_path / "in")
    shutil.copytree(
        root / "train" / "seq_00_day" / "00" / "fl_rgb",
        root / "train" / "seq_00_day" / "00" / "fl_ir",
    )
    source, expected = root, freiburg_files.reader(root)
    if form != "folders":
        source = tmp_path / "down"
        for part in ("train", "test"):
            top = part if form == "zips" else ""
            zipped(root / part, source / f"{part}.zip", top)
    reads = lambda out: freiburg_files.reader(Path(out))  # noqa: E731
    monkeypatch.setitem(prepare.KINDS, "freiburg", prepare.KINDS["freiburg"]._replace(reads=reads))
    out = tmp_path / "out"
    assert call("freiburg", source, out) == 0
    made = freiburg_files.reader(out)
    assert not list(out.rglob("fl_ir"))
    for split in ("train", "train_night", "val", "test"):
        assert made.names(split) == expected.names(split)
        for name in made.names(split):
            np.testing.assert_array_equal(made.read(name).thermal, expected.read(name).thermal)
            if split != "train_night":
                np.testing.assert_array_equal(made.label(name), expected.label(name))


def test_freiburg_in_other_capitals(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    freiburg_files.write_test(
        tmp_path / "in", "day", "157_0010", folders=("ImagesRgb", "ImagesIr", "SegmentationClass")
    )
    reads = lambda out: freiburg_files.reader(Path(out))  # noqa: E731
    monkeypatch.setitem(prepare.KINDS, "freiburg", prepare.KINDS["freiburg"]._replace(reads=reads))
    call("freiburg", zipped(tmp_path / "in" / "test", tmp_path / "test.zip"), tmp_path / "out")
    assert len(freiburg_files.reader(tmp_path / "out").names("test")) == 1
    with pytest.raises(InputError, match=r"holds neither train/seq_\*/\*/fl_rgb nor"):
        call(
            "freiburg",
            zipped(tmp_path / "out" / "test" / "day", tmp_path / "x.zip"),
            tmp_path / "o",
        )


class Stop(BaseException):
    """Stands for a kill."""


@pytest.mark.parametrize("number", [0, 1, 7, 16])
def test_interrupted_it_goes_on(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int
) -> None:
    """Stopped in the middle of a file, it leaves whole files, which are not copied again."""
    out = tmp_path / "out"
    chunks, begun = prepare_copy.Item.chunks, 0

    def stops(item: prepare_copy.Item) -> Iterator[bytes]:
        nonlocal begun
        begun += 1
        content = b"".join(chunks(item))
        yield content[: len(content) // 2]
        if begun > number:
            raise Stop
        yield content[len(content) // 2 :]

    with monkeypatch.context() as patch:
        patch.setattr(prepare_copy.Item, "chunks", stops)
        with pytest.raises(Stop):
            call("mfnet", mfnet, out)
    whole = [path for path in files_in(out) if not path.endswith(".part")]
    assert len(whole) == number
    for path in set(whole) - {"test_day.txt", "test_night.txt"}:
        assert (out / path).read_bytes() == (mfnet / path).read_bytes()
    before = {path: (out / path).stat().st_ino for path in whole}
    assert call("mfnet", mfnet, out) == 0
    assert files_in(out) == MF_OUT
    assert {path: (out / path).stat().st_ino for path in whole} == before


def test_done_it_checks_again(
    mfnet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert call("mfnet", mfnet, out) == 0
    text = capsys.readouterr().out
    assert "0 problem(s)" in text
    assert text.endswith(f"prepared: dataset=mfnet dataset.root={out}\n")
    before = state(out)
    assert call("mfnet", mfnet, out) == 0
    assert state(out) == before
    content = (mfnet / "images" / "00001D.png").read_bytes()
    (out / "images" / "00001D.png").write_bytes(content[:40])
    assert call("mfnet", mfnet, out) == 0, "cut short by a failure of power"
    assert (out / "images" / "00001D.png").read_bytes() == content


def write_stored(path: Path, value: int) -> None:
    """A label of one class whose length does not depend on it: PNG without compression."""
    label = np.full((6, 8), value, np.uint8)
    assert cv2.imwrite(str(path), label, [cv2.IMWRITE_PNG_COMPRESSION, 0])


def test_a_repaired_download_is_copied_again(mfnet: Path, tmp_path: Path) -> None:
    """Its files may be as long as they were; those that are the same are left alone."""
    label, out = mfnet / "labels" / "00002N.png", tmp_path / "out"
    write_stored(label, 1)
    assert call("mfnet", mfnet, out) == 0
    before, length = state(out), label.stat().st_size
    write_stored(label, 2)
    assert label.stat().st_size == length
    assert call("mfnet", mfnet, out) == 0
    assert (MFNet(str(out)).label("00002N") == 2).all()
    after = state(out)
    assert {path for path in before if before[path] != after[path]} == {"labels/00002N.png"}
    write_stored(out / "labels" / "00002N.png", 3)
    assert call("mfnet", mfnet, out) == 0
    assert (out / "labels" / "00002N.png").read_bytes() == label.read_bytes()


def test_files_that_the_download_does_not_hold(tmp_path: Path) -> None:
    """A reader that lists folders would take them for images of the split."""
    source, out = pst900_files.write_pst900(tmp_path / "in"), tmp_path / "out"
    assert call("pst900", source, out) == 0
    (out / "train" / "rgb" / ".DS_Store").touch()
    (out / "notes.txt").write_text("mine")
    assert call("pst900", source, out) == 0
    lost = pst900_files.TRAIN[0]
    for kind in ("rgb", "thermal", "labels"):
        (source / "train" / kind / f"{lost}.png").unlink()
    before = state(out)
    with pytest.raises(
        InputError,
        match=rf"^out: 3 files lie in .*out that the download does not hold, the first is .*"
        rf"train/labels/{lost}\.png; remove them, or name another folder\.$",
    ):
        call("pst900", source, out)
    assert state(out) == before
    for kind in ("rgb", "thermal", "labels"):
        (out / "train" / kind / f"{lost}.png").unlink()
    assert call("pst900", source, out) == 0
    assert lost not in PST900(str(out)).names("train")


def test_what_is_wrong_with_the_download_is_told(
    mfnet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_png(mfnet / "labels" / "00001D.png", np.full((6, 8), 77, np.uint8))
    assert call("mfnet", mfnet, tmp_path / "out") == 1
    assert "label value 77 is out of range" in capsys.readouterr().out


def test_a_folder_that_is_not_ours(mfnet: Path, tmp_path: Path) -> None:
    for out in (mfnet, mfnet / "new", mfnet / "images" / ".." / "new"):
        with pytest.raises(InputError, match=r"out: .* lies in .* outside"):
            call("mfnet", mfnet, out)
    link = tmp_path / "link"
    link.symlink_to(mfnet)
    with pytest.raises(InputError, match="lies in"):
        call("mfnet", mfnet, link / "new")
    used = tmp_path / "used"
    used.mkdir()
    (used / "thesis.tex").write_text("mine")
    with pytest.raises(InputError, match="is not empty and was not begun by this command"):
        call("mfnet", mfnet, used)
    with pytest.raises(InputError, match="is not empty"):
        call("mfnet", mfnet, used / "thesis.tex")
    assert files_in(used) == ["thesis.tex"]
    assert call("mfnet", mfnet, tmp_path / "out") == 0
    shutil.copytree(mfnet, tmp_path / "in2")
    with pytest.raises(InputError, match="was begun from something else"):
        call("mfnet", tmp_path / "in2", tmp_path / "out")
    (tmp_path / "out" / prepare_copy.PLAN).write_text("{")
    with pytest.raises(InputError, match="was begun from something else"):
        call("mfnet", mfnet, tmp_path / "out")


def test_one_at_a_time(mfnet: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    out.mkdir()
    plan = {"dataset": "mfnet", "source": str(mfnet.resolve())}
    (out / prepare_copy.PLAN).write_text(json.dumps(plan))
    with (out / prepare_copy.PLAN).open() as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        with pytest.raises(InputError, match=r"another process is preparing .*out"):
            call("mfnet", mfnet, out)
    assert call("mfnet", mfnet, out) == 0


def test_a_disk_that_is_too_small(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(
        prepare_copy.shutil, "disk_usage", lambda path: usage._replace(free=prepare_copy.SPARE)
    )
    with pytest.raises(InputError, match=r"GB are to be copied to .* has 0\.02 GB left"):
        call("mfnet", mfnet, tmp_path / "out")
    assert files_in(tmp_path / "out") == []
    monkeypatch.undo()

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device", "x.png")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        with pytest.raises(InputError, match=r"out: cannot write x\.png \(No space left"):
            call("mfnet", mfnet, tmp_path / "out2")
    assert call("mfnet", mfnet, tmp_path / "out") == 0


def test_a_download_that_still_grows(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chunks = prepare_copy.Item.chunks
    monkeypatch.setattr(prepare_copy.Item, "chunks", lambda item: iter([*chunks(item), b"more"]))
    with pytest.raises(InputError, match=r"00001D\.png holds \d+ bytes and not \d+, as was listed"):
        call("mfnet", mfnet, tmp_path / "out")
    assert [path for path in files_in(tmp_path / "out") if not path.endswith(".part")] == []


@pytest.mark.parametrize(
    "name", ["../x.png", "/etc/x.png", "a/../../x.png", "..\\x.png", "C:/x.png"]
)
def test_an_archive_that_leads_out(tmp_path: Path, name: str) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as writer:
        writer.writestr("images/00001D.png", b"1")
        writer.writestr(name, b"1")
    with pytest.raises(InputError, match=r"source: .*a\.zip holds '.*x\.png', which leads out"):
        call("mfnet", tmp_path / "a.zip", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_links_in_an_archive_are_left_out(tmp_path: Path) -> None:
    info = zipfile.ZipInfo("rgb/train/link.png")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as writer:
        writer.writestr(info, "/etc/passwd")
        writer.writestr("__MACOSX/._x.png", b"1")
        writer.writestr("train/.DS_Store", b"1")
        writer.writestr("train/x.png", b"1")
    with Source(tmp_path / "a.zip", "source") as source:
        assert list(source.entries) == ["a/train/x.png"]
        assert source.folders() == {"", "a", "a/train"}


def test_links_in_a_folder_are_copied_as_files(mfnet: Path, tmp_path: Path) -> None:
    shutil.move(mfnet / "images", tmp_path / "elsewhere")
    (mfnet / "images").symlink_to(tmp_path / "elsewhere")
    (mfnet / "loop").symlink_to(mfnet)
    with Source(mfnet, "source") as source:
        assert source.folders() == {"", "images", "labels"}
    assert call("mfnet", mfnet, tmp_path / "out") == 0
    assert files_in(tmp_path / "out") == MF_OUT
    assert not any(path.is_symlink() for path in (tmp_path / "out").rglob("*"))


def test_files_come_before_those_of_an_archive_beside_them(mfnet: Path, tmp_path: Path) -> None:
    archive = zipped(mfnet, mfnet.parent / "ir_seg_dataset.zip", "ir_seg_dataset")
    (mfnet / "train.txt").write_text("00001D\n")
    with Source(mfnet.parent, "source", r"ir_seg_dataset\.zip") as source:
        assert source.entries["ir_seg_dataset/train.txt"].lines() == ("00001D",)
        assert len(source.entries) == len(files_in(mfnet)) + 1
    with Source(archive, "source") as source:
        assert source.entries["ir_seg_dataset/train.txt"].lines() == tuple(MF["train"])


def test_damaged_archives(mfnet: Path, tmp_path: Path) -> None:
    whole = zipped(mfnet, tmp_path / "ir_seg_dataset.zip").read_bytes()
    cut = tmp_path / "cut.zip"
    cut.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"source: .*cut\.zip is no whole zip archive .*download"):
        call("mfnet", cut, tmp_path / "out")
    bad = bytearray(whole)
    with zipfile.ZipFile(tmp_path / "ir_seg_dataset.zip") as archive:
        member = archive.getinfo("images/00002N.png")
    bad[member.header_offset + 30 + len(member.filename) + 20] ^= 1
    (tmp_path / "bad.zip").write_bytes(bad)
    with pytest.raises(InputError, match=r"images/00002N\.png of .*bad\.zip cannot be read .*CRC"):
        call("mfnet", tmp_path / "bad.zip", tmp_path / "out")
    assert "images/00002N.png" not in files_in(tmp_path / "out")
    with zipfile.ZipFile(tmp_path / "locked.zip", "w") as writer:
        writer.writestr("images/00001D.png", b"1")
    locked = bytearray((tmp_path / "locked.zip").read_bytes())
    locked[locked.index(b"PK\1\2") + 8] |= 1
    (tmp_path / "locked.zip").write_bytes(locked)
    with pytest.raises(InputError, match=r"locked\.zip asks for a password"):
        call("mfnet", tmp_path / "locked.zip", tmp_path / "new")


def test_files_that_cannot_be_read(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = Path.open

    def refuses(path: Path, *args: Any, **kwargs: Any) -> Any:
        if path == mfnet / "images" / "00003D.png":
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *args, **kwargs)

    monkeypatch.setattr(Path, "open", refuses)
    with pytest.raises(InputError, match=r"images/00003D\.png cannot be read .*Permission denied"):
        call("mfnet", mfnet, tmp_path / "out")


def test_words_that_mean_nothing(mfnet: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"'dataset' must be 'mfnet', .* got \"mfnt\""):
        call("mfnt", mfnet, out)
    with pytest.raises(InputError, match=r"labels has no meaning for dataset=mfnet"):
        call("mfnet", mfnet, out, labels=mfnet)
    with pytest.raises(InputError, match=r"lists has no meaning for dataset=pst900"):
        call("pst900", mfnet, out, lists=mfnet)
    with pytest.raises(InputError, match=r"source: there is no file or folder '.*nowhere'"):
        call("mfnet", tmp_path / "nowhere", out)
    with pytest.raises(InputError, match=r"'sources' has no effect here; did you mean 'source'"):
        entry.run(["sources=x"])
    assert not out.exists()
