"""Every kind of bad file, in every data set: what the check says, and what training does.

Damage is done to one file of a sound data set after the other, and undone again.
"""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
import yaml

from rgbt.checks import InputError
from rgbt.data.check import check_dataset
from rgbt.data.kp import KP
from rgbt.data.loaders import LoaderSettings, eval_batches, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.video import MVSeg
from rgbt.dataset import LabelledDataset
from rgbt.transforms.crm import CrmTransform
from tests.conftest import write_data
from tests.data import folder_files, freiburg_files, kp_files, pst900_files, video_files

ROOT = Path(__file__).resolve().parents[2]
NAMES = {"train": ["00001D", "00002N"], "val": ["00003D"], "test": ["00004N"]}
MF_HW = (12, 16)


class Kind(NamedTuple):
    """A data set: its reader, what writes it, whether folders say which frames there are.

    And whether frames may lack their label.
    """

    make: Callable[[Path], LabelledDataset]
    write: Callable[[Path], Path]
    is_listed: bool = False
    is_sparse: bool = False


KINDS = {
    "mfnet packed": Kind(
        lambda root: MFNet(str(root)), lambda root: write_data(root, NAMES, MF_HW)
    ),
    "mfnet folders": Kind(
        lambda root: MFNet(str(root)), lambda root: write_data(root, NAMES, MF_HW, "folders")
    ),
    "freiburg": Kind(freiburg_files.reader, freiburg_files.write_freiburg, is_listed=True),
    "pst900": Kind(lambda root: PST900(str(root)), pst900_files.write_pst900, is_listed=True),
    "kp": Kind(
        lambda root: KP(str(root)), lambda root: kp_files.write_lists(kp_files.write_kp(root))
    ),
    "folder": Kind(folder_files.folder, folder_files.write_folder, is_listed=True),
    "mvseg": Kind(
        lambda root: MVSeg(str(root)), video_files.write_mvseg, is_listed=True, is_sparse=True
    ),
    "video": Kind(video_files.video, video_files.write_videos, is_listed=True, is_sparse=True),
}


def read(path: Path) -> np.ndarray:
    """The array that a file holds."""
    is_array = path.suffix == ".npy"
    return np.asarray(np.load(path) if is_array else cv2.imread(str(path), cv2.IMREAD_UNCHANGED))


def save(path: Path, array: np.ndarray) -> None:
    """In a format that keeps values, whatever the name ends in."""
    if path.suffix == ".npy":
        np.save(path, array)
    else:
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


def make_folder(path: Path, _: Path) -> None:
    path.unlink()
    path.mkdir()


def make_pipe(path: Path, _: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def change_depth(path: Path, _: Path) -> None:
    array = read(path)
    other = {np.uint8: np.uint16, np.uint16: np.uint8}.get(array.dtype.type, np.float64)
    save(path, array.astype(other))


def change_size(path: Path, _: Path) -> None:
    save(path, read(path)[:-4, :-2])


def change_values(path: Path, _: Path) -> None:
    save(path, np.full_like(read(path), 77))


DAMAGES: dict[str, tuple[Callable[[Path, Path], None], str]] = {
    "missing": (move, "is missing"),
    "empty": (partial(fill, content=b""), "cannot be (decoded|read as an array)"),
    "cut short": (cut, "cannot be (decoded|read as an array)"),
    "no image": (partial(fill, content=b"<html>404</html>"), "cannot be (decoded|read as an arr)"),
    "a folder": (make_folder, "is not a regular file"),
    "a pipe": (make_pipe, "is not a regular file"),
    "a link that leads out": (partial(move, link="kept"), "leads out of dataset.root, to .*kept."),
    "a link to nowhere": (partial(move, link="gone"), r"is missing \(a link to .*/gone\)"),
    "another depth": (change_depth, "8 bits|of 16 bits|whole numbers|got uint8"),
    "another size": (change_size, r"is \d+x\d+ pixels but|which is another aspect ratio"),
    "an unknown value": (change_values, "label value 77 "),
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


def assert_names_the_problem(sentence: str, what: str, path: Path, name: str) -> None:
    """One sentence says what is wrong, and with which file or sample."""
    assert re.search(DAMAGES[what][1], sentence), (what, sentence)
    assert str(path) in sentence or f"'{name}'" in sentence, sentence
    assert "\n" not in sentence


@pytest.fixture
def outside(tmp_path: Path) -> Path:
    (tmp_path / "elsewhere").mkdir()
    return tmp_path / "elsewhere"


@pytest.mark.parametrize("kind", KINDS)
def test_check_reports_each_problem_in_one_line(kind: str, tmp_path: Path, outside: Path) -> None:
    make, root = KINDS[kind].make, KINDS[kind].write(tmp_path / "data")
    sound = check_dataset(make(root)).problems
    name = make(root).names("test")[0]
    done = set()
    for what, path in cases(kind, make(root).files(name)):
        with damaged(path, what, outside):
            problems = check_dataset(make(root), num_threads=1).problems
        told = [line for line in problems if line not in sound]
        assert len(told) == 1, (what, path, told)
        assert_names_the_problem(told[0], what, path, name)
        done.add(what)
    assert done == set(DAMAGES)
    assert check_dataset(make(root)).problems == sound


def loaded(dataset: LabelledDataset, split: str, on_error: Any) -> tuple[list[str], dict[str, str]]:
    """Names that one pass over `split` hands out, and what it notes of others.

    "train" is trained on, all else evaluated.
    """
    node = yaml.safe_load((ROOT / "conf/transform/none.yaml").read_text())
    transform = CrmTransform(**{key: value for key, value in node.items() if key != "_target_"})
    settings = LoaderSettings(batch_size=1, eval_batch_size=1, num_workers=0, on_error=on_error)
    if split == "train":
        steps = range(len(dataset.names(split)))
        batches = train_batches(dataset, split, transform, settings, 0, steps)
    else:
        batches = eval_batches(dataset, split, transform, settings)
    return [name for batch in batches for name in batch.name], batches.skipped


@pytest.mark.parametrize("split", ["train", "test"])
@pytest.mark.parametrize("kind", KINDS)
def test_the_loader_stops_or_goes_on(kind: str, split: str, tmp_path: Path, outside: Path) -> None:
    dataset = KINDS[kind].make(KINDS[kind].write(tmp_path / "data"))
    names = list(dataset.names(split))
    name = names[0]
    thermal = dataset.files(name)[-2]
    for what, path in cases(kind, dataset.files(name)):
        if path not in (thermal, dataset.files(name)[-1]):
            continue
        with damaged(path, what, outside):
            with pytest.raises(InputError) as told:
                loaded(dataset, split, "raise")
            assert_names_the_problem(str(told.value), what, path, name)
            if len(names) > 1:
                found, skipped = loaded(dataset, split, "skip")
                assert set(found) == set(names) - {name}
                # In training another sample stands in for it, in evaluation none.
                assert len(found) == len(names) - (split != "train")
                assert skipped == {name: str(told.value)}
    assert sorted(loaded(dataset, split, "raise")[0]) == sorted(names)
