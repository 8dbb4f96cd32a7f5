from __future__ import annotations

import fcntl
import json
import os
import shutil
import stat
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.kp_layout import SPLITS
from rgbt.data.mfnet import MFNet
from rgbt.data.prepare import copying
from rgbt.data.prepare.__main__ import entry
from rgbt.data.prepare.download import SourceFile, SourceFiles
from rgbt.data.prepare.plans import PREPARATIONS, Download, plan_kp
from rgbt.data.pst900 import PST900
from tests.conftest import write_data, write_png
from tests.data import freiburg_files, kp_files, pst900_files

SHARED = Path(os.environ.get("RGBT_SHARED", Path(__file__).parents[3] / "shared"))
MF = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["01402D", "01189N", "01403D"]}


def call(dataset: str, source: Path, out: Path, **others: Path | str) -> int:
    """The command; its exit code."""
    words = {"dataset": dataset, "source": source, "out": out, **others}
    return entry.run([f"{key}={value}" for key, value in words.items()]) or 0


def refused(said: str, dataset: str, source: Path, out: Path, **others: Path) -> None:
    """The command refuses these arguments."""
    with pytest.raises(InputError, match=said):
        call(dataset, source, out, **others)


def files_in(root: Path) -> list[str]:
    """What a folder holds but for the note of the command."""
    paths = (path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    return sorted(path for path in paths if path != copying.PLAN)


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
def small_freiburg(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader of the images of the tests, which are smaller than those of Freiburg."""

    def read(root: str) -> Freiburg:
        return freiburg_files.reader(Path(root))

    small = PREPARATIONS["freiburg"]._replace(reader=read)
    monkeypatch.setitem(PREPARATIONS, "freiburg", small)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    return tmp_path / "out"


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


@pytest.mark.parametrize("form", ["zip", "above", "zip below"])
def test_mfnet(mfnet: Path, tmp_path: Path, form: str, out: Path) -> None:
    source = {"folder": mfnet, "above": mfnet.parent}.get(form)
    if source is None:
        archive = zipped(mfnet, tmp_path / "down" / "ir_seg_dataset.zip", "ir_seg_dataset")
        source = archive if form == "zip" else archive.parent
    before = state(mfnet)
    assert call("mfnet", source, out) == 0
    assert state(mfnet) == before
    assert files_in(out) == MF_OUT
    made, given = MFNet(str(out)), MFNet(str(mfnet))
    for name in MF["test"]:
        np.testing.assert_array_equal(made.read(name).rgb, given.read(name).rgb)
    assert made.names("test_day") == ("01402D", "01403D")
    assert made.names("test_night") == ("01189N",)
    assert not any(path.is_symlink() for path in out.rglob("*"))


def test_mfnet_in_three_folders(tmp_path: Path, out: Path) -> None:
    root = write_data(tmp_path / "MFNet", MF, (6, 8), layout="folders")
    (root / "test_day.txt").write_text("01402D\n")
    assert call("mfnet", root, out) == 0
    assert MFNet(str(out)).layout == "folders"
    found = files_in(out)
    assert "test_day.txt" in found
    assert "test_night.txt" not in found, "who wrote one list decided about the other"
    assert (out / "test_day.txt").read_text() == "01402D\n"


def test_listed_mirrored_copies_are_copied(tmp_path: Path, out: Path) -> None:
    names = {**MF, "train": [*MF["train"], "00001D_flip", "00002N_flip"]}
    root = write_data(tmp_path / "in", names, (6, 8))
    assert call("mfnet", root, out) == 0
    assert "images/00001D_flip.png" in files_in(out)
    lists = write_data(tmp_path / "lists", {"train": MF["train"]}, (6, 8))
    assert call("mfnet", root, tmp_path / "less", lists=lists) == 1, "no list for val and test"
    assert files_in(tmp_path / "less") == sorted(
        ["train.txt"] + [f"{kind}/{n}.png" for kind in ("images", "labels") for n in MF["train"]]
    )


def without_pair(source: Path) -> None:
    (source / "labels" / "00003D.png").unlink()
    (source / "images" / "00002N.png").unlink()


def without_lists(source: Path) -> None:
    for split in MF:
        (source / f"{split}.txt").unlink()


def with_outside_line(source: Path) -> None:
    write_png(source.parent / "images" / "x.png", np.zeros((6, 8, 4), np.uint8))
    (source / "train.txt").write_text("../../images/x\n")


def twice(source: Path) -> None:
    shutil.move(source, source.parent / "kept")
    for name in ("a", "b"):
        shutil.copytree(source.parent / "kept", source / name)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (without_pair, r"2 listed files .* images/00002N.png, of .*train"),
        (without_lists, r"source: .* contains none of the lists train\.txt, .*lists=\.\.\."),
        (with_outside_line, "2 listed files are not in"),
        (twice, r"several times \(a/, b/\)"),
        (shutil.rmtree, "source: '.*' does not exist"),
    ],
)
def test_incomplete_mfnet_is_refused(
    mfnet: Path, tmp_path: Path, change: Callable[[Path], None], said: str, out: Path
) -> None:
    change(mfnet)
    with pytest.raises(InputError, match=said):
        call("mfnet", mfnet, out)
    assert not out.exists(), "nothing was written"


def test_data_set_three_folders_deep_is_prepared(mfnet: Path, tmp_path: Path, out: Path) -> None:
    shutil.move(mfnet, tmp_path / "a" / "b" / "c" / "d")
    assert call("mfnet", tmp_path / "a", out) == 0
    refused("does not contain the folders train", "pst900", tmp_path / "a", tmp_path / "other")


@pytest.mark.parametrize("form", ["zip", "above"])
def test_pst900(tmp_path: Path, form: str, out: Path) -> None:
    root = pst900_files.write_pst900(tmp_path / "in" / "PST900_RGBT_Dataset")
    source = {"folder": root, "above": root.parent}.get(form)
    source = source or zipped(root, tmp_path / "PST900_RGBT_Dataset.zip", "PST900_RGBT_Dataset")
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


@pytest.mark.parametrize("below", ["", "a/kaist-cvpr15/images"])
def test_kp_from_kaist(tmp_path: Path, below: str, out: Path) -> None:
    source, labels = kaist(tmp_path, below=below)
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


def test_kp_from_archives_by_set(tmp_path: Path, out: Path) -> None:
    source, labels = kaist(tmp_path)
    for number, folder in enumerate(sorted(source.iterdir())):
        # Some archives hold their folder and some its contents.
        zipped(folder, source / f"{folder.name}.zip", folder.name if number % 2 else "")
        shutil.rmtree(folder)
    archive = zipped(labels, tmp_path / "labels.zip")
    assert call("kp", source, out, labels=archive) == 0
    assert files_in(out) == KP_OUT


@pytest.mark.parametrize("given", ["labels", "together"])
def test_kp_as_ms_uda_has_it(tmp_path: Path, given: str, out: Path) -> None:
    root = kp_files.write_ms_uda(tmp_path / "ms")
    # Labels of a network, of the same frames and of others.
    shutil.copytree(root / "labels" / "val_day", root / "labels" / "day")
    write_png(root / "labels" / "day" / "set00_V000_I00099.png", np.zeros((16, 24), np.uint8))
    others = {"labels": root / "labels"} if given == "labels" else {}
    source = root / "pseudo_KP" if given == "labels" else root
    assert call("kp", source, out, **others) == 0
    dataset = KP(str(out))
    assert sorted(dataset.names("train") + dataset.names("val") + dataset.names("test")) == sorted(
        kp_files.NAMES
    )
    for name in kp_files.NAMES:
        rgb, thermal, label = kp_files.contents(name)
        sample = dataset.read(name)
        np.testing.assert_array_equal(sample.rgb, rgb)
        np.testing.assert_array_equal(sample.thermal, thermal)
        np.testing.assert_array_equal(sample.label, np.where(label == 19, 255, label))


def test_kp_with_lists_of_ones_own(tmp_path: Path, out: Path) -> None:
    source, labels = kaist(tmp_path)
    (tmp_path / "lists").mkdir()
    lists = kp_files.write_lists(tmp_path / "lists", {"train": kp_files.VAL, "test": kp_files.TEST})
    call("kp", source, out, labels=labels, lists=lists)
    found = files_in(out)
    assert [path for path in found if path.endswith(".txt")] == ["test.txt", "train.txt"]
    assert KP(str(out)).names("train") == kp_files.VAL
    assert f"labels/{kp_files.TRAIN[0]}.png" not in found
    (lists / "train.txt").write_text("set00_V000_I00051.png\n")
    refused(
        "1 names have no label in .*set00_V000_I00051",
        "kp",
        source,
        tmp_path / "b",
        labels=labels,
        lists=lists,
    )
    (lists / "train.txt").write_text("nonsense\n")
    refused(
        r"lists: 'nonsense' in .*train\.txt is not a name",
        "kp",
        source,
        tmp_path / "b",
        labels=labels,
        lists=lists,
    )
    refused("lists: .* contains none of", "kp", source, tmp_path / "b", labels=labels, lists=source)


def test_incomplete_kp_is_refused(tmp_path: Path, out: Path) -> None:
    source, labels = kaist(tmp_path)
    refused(r"source: there is no label such as .*labels=\.\.\.", "kp", source, out)
    shutil.rmtree(source / "set03")
    (source / "set06" / "V000" / "lwir" / "I00253.jpg").unlink()
    refused("3 of the 18 images .* first is set03/V001/v", "kp", source, out, labels=labels)
    write_png(labels / "set12_V000_I00001.png", np.zeros((2, 2), np.uint8))
    refused("set12_V000_I00001.png is not a name", "kp", source, out, labels=labels)
    (labels / "set12_V000_I00001.png").unlink()
    shutil.copytree(labels, labels / "copy")
    refused("copy/set00.* would both be set00_V000_I00050", "kp", source, out, labels=labels)
    assert not out.exists()


def test_lists_of_kp_equal_release(tmp_path: Path) -> None:
    published = SHARED / "realdata" / "kp_names"
    if not published.is_dir():
        pytest.skip("published lists are not part of the repository")
    names = [
        n[:-4]
        for s in ("train", "val", "test")
        for n in (published / f"{s}.txt").read_text().split()
    ]
    assert len(names) == 950
    source = SourceFiles.__new__(SourceFiles)
    source.path, source.key = tmp_path, "source"
    paths = [f"labels/{name}.png" for name in names]
    paths += [
        f"{name[:5]}/{name[6:10]}/{kind}/{name[11:]}.jpg"
        for name in names
        for kind in ("visible", "lwir")
    ]
    source.entries = {path: SourceFile(path, 1, tmp_path / path) for path in paths}
    items = {item.target: item.content for item in plan_kp(Download(source))}
    assert len(items) == 3 * 950 + 9
    for path in sorted(published.glob("*.txt")):
        assert items[path.name].split() == path.read_bytes().split()
    assert sum(target.endswith(".txt") for target in items) == len(list(published.glob("*.txt")))


@pytest.mark.parametrize("form", ["zips", "zips without a folder in them", "folders"])
def test_freiburg(tmp_path: Path, small_freiburg: None, form: str, out: Path) -> None:
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
    assert call("freiburg", source, out) == 0
    made = freiburg_files.reader(out)
    assert not list(out.rglob("fl_ir"))
    for split in ("train", "train_night", "val", "test"):
        assert made.names(split) == expected.names(split)
        for name in made.names(split):
            np.testing.assert_array_equal(made.read(name).thermal, expected.read(name).thermal)
            if split != "train_night":
                np.testing.assert_array_equal(made.label(name), expected.label(name))


def test_freiburg_in_other_capitals(tmp_path: Path, small_freiburg: None, out: Path) -> None:
    freiburg_files.write_test(
        tmp_path / "in", "day", "157_0010", folders=("ImagesRgb", "ImagesIr", "SegmentationClass")
    )
    call("freiburg", zipped(tmp_path / "in" / "test", tmp_path / "test.zip"), out)
    assert len(freiburg_files.reader(out).names("test")) == 1
    refused(
        r"holds neither train/seq_\*/\*/fl_rgb nor",
        "freiburg",
        zipped(out / "test" / "day", tmp_path / "x.zip"),
        tmp_path / "o",
    )


class Stop(BaseException):
    """Stands for a kill that leaves the temporary folder."""


@pytest.mark.parametrize("number", [0, 7])
def test_interrupted_copy_leaves_no_out(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int, out: Path
) -> None:
    out, begun, write = out, 0, copying._write

    def stops(item: copying.Item, path: Path) -> None:
        nonlocal begun
        begun += 1
        if begun > number:
            raise Stop
        write(item, path)

    with monkeypatch.context() as patch:
        patch.setattr(copying, "_write", stops)
        patch.setattr(copying.shutil, "rmtree", lambda path: None)
        with pytest.raises(Stop):
            call("mfnet", mfnet, out)
    assert not out.exists()
    (left,) = tmp_path.glob(".out*")
    assert len(files_in(left)) == number
    (left / "train.txt").write_text("00009D\n")
    assert call("mfnet", mfnet, out) == 0
    assert files_in(out) == MF_OUT
    assert not left.exists()


def test_repeated_command_compares_every_byte(
    mfnet: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], out: Path
) -> None:
    label = mfnet / "labels" / "00002N.png"
    write_uncompressed(label, 1)
    assert call("mfnet", mfnet, out) == 0
    text = capsys.readouterr().out
    assert "0 problem(s)" in text
    assert json.loads((out / copying.PLAN).read_text())["source"] == str(mfnet)
    assert text.endswith(f"prepared: dataset=mfnet dataset.root={out}\n")
    (out / "notes.txt").write_text("mine")
    before, length = state(out), label.stat().st_size
    assert call("mfnet", mfnet, out) == 0
    write_uncompressed(label, 2)
    assert label.stat().st_size == length
    refused(r"differs .* in 1 files; the first is .*labels/00002N", "mfnet", mfnet, out)
    (out / "images" / "00001D.png").unlink()
    refused("differs .* in 2 files", "mfnet", mfnet, out)
    assert {path: before[path] for path in files_in(out)} == state(out)


def write_uncompressed(path: Path, value: int) -> None:
    """A label of one class whose length does not depend on it: PNG without compression."""
    label = np.full((6, 8), value, np.uint8)
    assert cv2.imwrite(str(path), label, [cv2.IMWRITE_PNG_COMPRESSION, 0])


def test_other_files_in_out_are_refused(tmp_path: Path, out: Path) -> None:
    """A reader that lists folders would take them for images of the split."""
    source = pst900_files.write_pst900(tmp_path / "in")
    assert call("pst900", source, out) == 0
    (out / "train" / "rgb" / ".DS_Store").touch()
    assert call("pst900", source, out) == 0
    for kind in ("rgb", "thermal", "labels"):
        (source / "train" / kind / f"{pst900_files.TRAIN[0]}.png").unlink()
    before = state(out)
    refused(r"^out: .* in 3 files; the first is .*train/labels/", "pst900", source, out)
    assert state(out) == before


def test_foreign_out_folder_is_refused(mfnet: Path, tmp_path: Path) -> None:
    for out in (mfnet, mfnet / "new", mfnet / "images" / ".." / "new"):
        refused(r"out: .* is inside .* outside", "mfnet", mfnet, out)
    link = tmp_path / "link"
    link.symlink_to(mfnet)
    refused("is inside", "mfnet", mfnet, link / "new")
    used = tmp_path / "used"
    used.mkdir()
    (used / "thesis.tex").write_text("mine")
    refused("is not empty and differs", "mfnet", mfnet, used)
    refused("is not empty", "mfnet", mfnet, used / "thesis.tex")
    assert files_in(used) == ["thesis.tex"]


def test_second_process_is_refused(mfnet: Path, tmp_path: Path, out: Path) -> None:
    folder = tmp_path / ".out.preparing"
    folder.mkdir()
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX)
    refused(r"another process is preparing .*out", "mfnet", mfnet, out)
    os.close(descriptor)
    assert call("mfnet", mfnet, out) == 0


def test_too_small_disk_is_refused(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    usage = shutil.disk_usage("/")
    monkeypatch.setattr(
        copying.shutil, "disk_usage", lambda path: usage._replace(free=copying.SPARE)
    )
    refused(r"GB must be copied to .* has 0\.02 GB left", "mfnet", mfnet, out)
    assert list(tmp_path.glob("*out*")) == []
    monkeypatch.undo()

    def full(*args: Any) -> None:
        raise OSError(28, "No space left on device", "x.png")

    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", full)
        refused(r"out: cannot write x\.png \(No space left", "mfnet", mfnet, tmp_path / "out2")
    assert call("mfnet", mfnet, out) == 0


def test_growing_download_is_refused(
    mfnet: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, out: Path
) -> None:
    chunks = copying.Item.chunks
    monkeypatch.setattr(copying.Item, "chunks", lambda item: iter([*chunks(item), b"more"]))
    refused(r"00001D\.png holds \d+ bytes but \d+ were listed", "mfnet", mfnet, out)
    assert list(tmp_path.glob("*out*")) == []


@pytest.mark.parametrize(
    "name", ["../x.png", "/etc/x.png", "a/../../x.png", "..\\x.png", "C:/x.png"]
)
def test_archive_with_outside_path_is_refused(tmp_path: Path, name: str, out: Path) -> None:
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as writer:
        writer.writestr("images/00001D.png", b"1")
        writer.writestr(name, b"1")
    refused(
        r"source: .*a\.zip holds '.*x\.png', which is outside", "mfnet", tmp_path / "a.zip", out
    )
    assert not out.exists()


def test_links_in_an_archive_are_left_out(tmp_path: Path) -> None:
    info = zipfile.ZipInfo("rgb/train/link.png")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as writer:
        writer.writestr(info, "/etc/passwd")
        writer.writestr("__MACOSX/._x.png", b"1")
        writer.writestr("train/.DS_Store", b"1")
        writer.writestr("train/x.png", b"1")
    with SourceFiles(tmp_path / "a.zip", "source") as source:
        assert list(source.entries) == ["a/train/x.png"]
        assert source.folders() == {"", "a", "a/train"}


def test_links_in_a_folder_are_copied_as_files(mfnet: Path, tmp_path: Path, out: Path) -> None:
    shutil.move(mfnet / "images", tmp_path / "elsewhere")
    (mfnet / "images").symlink_to(tmp_path / "elsewhere")
    (mfnet / "loop").symlink_to(mfnet)
    assert call("mfnet", mfnet, out) == 0
    assert files_in(out) == MF_OUT
    assert not any(path.is_symlink() for path in out.rglob("*"))


def test_files_have_precedence_over_archive(mfnet: Path, tmp_path: Path) -> None:
    archive = zipped(mfnet, mfnet.parent / "ir_seg_dataset.zip", "ir_seg_dataset")
    (mfnet / "train.txt").write_text("00001D\n")
    with SourceFiles(mfnet.parent, "source", r"ir_seg_dataset\.zip") as source:
        assert source.entries["ir_seg_dataset/train.txt"].lines() == ("00001D",)
        assert len(source.entries) == len(files_in(mfnet)) + 1
    with SourceFiles(archive, "source") as source:
        assert source.entries["ir_seg_dataset/train.txt"].lines() == tuple(MF["train"])


def test_damaged_archives(mfnet: Path, tmp_path: Path, out: Path) -> None:
    whole = zipped(mfnet, tmp_path / "ir_seg_dataset.zip").read_bytes()
    cut = tmp_path / "cut.zip"
    cut.write_bytes(whole[: len(whole) // 2])
    refused(r"source: .*cut\.zip is not a complete zip archive", "mfnet", cut, out)
    bad = bytearray(whole)
    with zipfile.ZipFile(tmp_path / "ir_seg_dataset.zip") as archive:
        member = archive.getinfo("images/00002N.png")
    bad[member.header_offset + 30 + len(member.filename) + 20] ^= 1
    (tmp_path / "bad.zip").write_bytes(bad)
    refused(
        r"images/00002N\.png of .*bad\.zip cannot be read .*CRC", "mfnet", tmp_path / "bad.zip", out
    )
    assert list(tmp_path.glob("*out*")) == []
    with zipfile.ZipFile(tmp_path / "locked.zip", "w") as writer:
        writer.writestr("images/00001D.png", b"1")
    locked = bytearray((tmp_path / "locked.zip").read_bytes())
    locked[locked.index(b"PK\1\2") + 8] |= 1
    (tmp_path / "locked.zip").write_bytes(locked)
    refused(r"locked\.zip is encrypted", "mfnet", tmp_path / "locked.zip", tmp_path / "new")


def test_arguments_without_effect_are_refused(mfnet: Path, tmp_path: Path, out: Path) -> None:
    refused(r"dataset: 'mfnt' is not a valid choice; did you mean 'mfnet'", "mfnt", mfnet, out)
    refused(r"labels has no effect for dataset=mfnet", "mfnet", mfnet, out, labels=mfnet)
    refused(r"lists has no effect for dataset=pst900", "pst900", mfnet, out, lists=mfnet)
    with pytest.raises(InputError, match=r"'sources' has no effect here; did you mean 'source'"):
        entry.run(["sources=x"])
    assert not out.exists()
