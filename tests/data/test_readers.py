"""What holds for the reader of every data set, and what the check says of every kind of bad file.

Damage is done to one file of a sound data set after the other, and undone again.
"""

from __future__ import annotations

import hashlib
import inspect
import os
import pickle
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from rgbt.data.check import check_dataset
from rgbt.data.file_dataset import FileDataset, hash_of_files
from rgbt.data.folder import Folder
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.video import MVSeg
from tests.data.layouts import KINDS, refused

ROOT = Path(__file__).resolve().parents[2]
READERS = {"mfnet": MFNet, "pst900": PST900, "kp": KP, "freiburg": Freiburg, "mvseg": MVSeg}


def made(kind: str, root: Path) -> FileDataset:
    return KINDS[kind].make(KINDS[kind].write(root))


@pytest.mark.parametrize("name", [*READERS, "folder"])
def test_configuration_repeats_the_defaults(name: str) -> None:
    node = yaml.safe_load((ROOT / "conf/dataset" / f"{name}.yaml").read_text())
    parameters = inspect.signature((READERS | {"folder": Folder})[name]).parameters
    assert set(node) == {"_target_", "absent", *parameters}
    for key in set(parameters) - {"root"}:
        default = parameters[key].default
        is_given = default is not inspect.Parameter.empty
        expected = yaml.dump(default).replace("!!python/tuple", "") if is_given else "???"
        assert node[key] == yaml.safe_load(expected), key


@pytest.mark.parametrize("kind", KINDS)
def test_fingerprint_is_of_names_and_sizes(kind: str, tmp_path: Path) -> None:
    dataset, other = made(kind, tmp_path / "one"), made(kind, tmp_path / "other")
    expected = dataset.fingerprint()
    assert len(expected) == 64
    assert other.fingerprint() == expected
    seen = {expected}
    path = other.files(other.names("test")[0])[-1]
    for change in (lambda: path.write_bytes(b"x"), lambda: path.write_bytes(b""), path.unlink):
        change()
        seen.add(other.fingerprint())
    assert len(seen) == 4  # a missing file is no empty one
    text = "test 0\ntrain 2\na [3]\nb [-1]\n"
    (tmp_path / "a").write_bytes(b"123")
    found = hash_of_files({"train": ("a", "b"), "test": ()}, lambda name: [tmp_path / name])
    assert found == hashlib.sha256(text.encode()).hexdigest()


@pytest.mark.parametrize("kind", KINDS)
def test_reader_reaches_a_worker_and_refuses_other_splits(kind: str, tmp_path: Path) -> None:
    dataset = made(kind, tmp_path / "data")
    name = dataset.names("test")[0]
    copy = pickle.loads(pickle.dumps(dataset))
    assert np.array_equal(copy.read(name).thermal, dataset.read(name).thermal)
    assert np.array_equal(dataset.pair(name).rgb, dataset.read(name).rgb)
    assert np.array_equal(dataset.label(name), dataset.read(name).label)
    for ask in (dataset.names, dataset.has):
        assert "no split 'tets'; did you mean 'test'" in refused(lambda ask=ask: ask("tets"))


def test_wrong_roots_and_numbers_are_refused(tmp_path: Path) -> None:
    root = str(KINDS["kp"].write(tmp_path / "data"))
    for place, keys, said in (
        *(("/nowhere", {}, "no such folder: /nowhere"), (str(tmp_path), {}, "dataset.root")),
        (root, {"num_classes": 3}, "num_classes is 3 but dataset.classes has"),
        (root, {"palette": ((0, 0, 0),)}, "num_classes is 19 but dataset.palette has"),
    ):
        assert said in refused(lambda place=place, keys=keys: KP(place, **keys))


# Bad files.


def to_other_depth(array: np.ndarray) -> np.ndarray:
    other = {np.uint8: np.uint16, np.uint16: np.uint8}.get(array.dtype.type, np.float64)
    return array.astype(other)


def change(path: Path, _: Path, *, by: Callable[[np.ndarray], np.ndarray] = to_other_depth) -> None:
    """In a format that keeps values, whatever the name ends in."""
    if path.suffix == ".npy":
        np.save(path, by(np.load(path)))
    else:
        array = by(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
        path.write_bytes(cv2.imencode(".png", array)[1].tobytes())


def cut(path: Path, _: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def fill(path: Path, _: Path, *, content: bytes) -> None:
    path.write_bytes(content)


def move(path: Path, outside: Path, *, link: str | None = None) -> None:
    """The file elsewhere, and in its place nothing, or a link."""
    path.rename(outside / "kept")
    if link is not None:
        path.symlink_to(outside / link)


def replace(path: Path, _: Path, *, by: Callable[[Path], None]) -> None:
    path.unlink()
    by(path)


DAMAGES: dict[str, tuple[Callable[[Path, Path], None], str]] = {
    "missing": (move, "is missing"),
    "empty": (partial(fill, content=b""), "cannot be (decoded|read as an array)"),
    "cut short": (cut, "cannot be (decoded|read as an array)"),
    "no image": (partial(fill, content=b"<html>404</html>"), "cannot be (decoded|read as an arr)"),
    "a folder": (partial(replace, by=Path.mkdir), "is not a regular file"),
    "a pipe": (partial(replace, by=os.mkfifo), "is not a regular file"),
    "a link that leads out": (partial(move, link="kept"), "leads out of dataset.root, to .*kept."),
    "a link to nowhere": (partial(move, link="gone"), r"is missing \(a link to .*/gone\)"),
    "another depth": (change, "8 bits|whole numbers|got uint8"),
    "another size": (
        partial(change, by=lambda array: array[:-4, :-2]),
        r"is \d+x\d+ pixels but|which is another aspect ratio",
    ),
    "an unknown value": (
        partial(change, by=lambda array: np.full_like(array, 77)),
        "label value 77 ",
    ),
}


def cases(kind: str, files: tuple[Path, ...]) -> Iterator[tuple[str, Path]]:
    """What can be done to which file so that the data set is no longer sound."""
    for what in DAMAGES:
        for path in files:
            is_rgb, is_label = path == files[0], path == files[-1]
            unseen = what == "missing" and (
                (is_rgb and KINDS[kind].is_listed) or (is_label and KINDS[kind].is_sparse)
            )
            own_depth = what == "another depth" and is_label and kind in ("folder", "video")
            if not unseen and not own_depth and (is_label or what != "an unknown value"):
                yield what, path


@contextmanager
def damaged(path: Path, what: str, outside: Path) -> Iterator[None]:
    """`path` after the damage, and as it was before once this is left."""
    whole = path.read_bytes()
    DAMAGES[what][0](path, outside)
    try:
        yield
    finally:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        path.write_bytes(whole)


@pytest.mark.parametrize("kind", KINDS)
def test_check_reports_each_problem_in_one_line(kind: str, tmp_path: Path) -> None:
    (tmp_path / "elsewhere").mkdir()
    make, root = KINDS[kind].make, KINDS[kind].write(tmp_path / "data")
    sound = check_dataset(make(root)).problems
    name = make(root).names("test")[0]
    done = set()
    for what, path in cases(kind, make(root).files(name)):
        with damaged(path, what, tmp_path / "elsewhere"):
            problems = check_dataset(make(root), num_threads=1).problems
        (told,) = [line for line in problems if line not in sound]
        assert re.search(DAMAGES[what][1], told), (what, told)
        assert str(path) in told or f"'{name}'" in told, told
        assert "\n" not in told
        done.add(what)
    assert done == set(DAMAGES)
