"""What holds for the reader of every data set."""

from __future__ import annotations

import inspect
import pickle
from pathlib import Path

import numpy as np
import pytest
import yaml

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset, hash_of_files
from rgbt.data.freiburg import Freiburg
from rgbt.data.kp import KP
from rgbt.data.mfnet import MFNet
from rgbt.data.pst900 import PST900
from rgbt.data.video import MVSeg
from tests.data.test_bad_data import KINDS

ROOT = Path(__file__).resolve().parents[2]
READERS = {"mfnet": MFNet, "pst900": PST900, "kp": KP, "freiburg": Freiburg, "mvseg": MVSeg}


def made(kind: str, root: Path) -> FileDataset:
    return KINDS[kind].make(KINDS[kind].write(root))


@pytest.mark.parametrize("name", READERS)
def test_configuration_repeats_the_defaults(name: str) -> None:
    node = yaml.safe_load((ROOT / "conf/dataset" / f"{name}.yaml").read_text())
    parameters = inspect.signature(READERS[name]).parameters
    assert set(node) == {"_target_", "absent", *parameters}
    for key in set(parameters) - {"root"}:
        default = parameters[key].default
        assert node[key] == yaml.safe_load(yaml.dump(default).replace("!!python/tuple", "")), key


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


def test_hash_of_files_known_answer(tmp_path: Path) -> None:
    import hashlib

    (tmp_path / "a").write_bytes(b"123")
    text = "test 0\ntrain 2\na [3]\nb [-1]\n"
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
        with pytest.raises(InputError, match="no split 'tets'; did you mean 'test'"):
            ask("tets")


@pytest.mark.parametrize("reader", READERS.values())
def test_wrong_roots_and_numbers_are_refused(reader: type[FileDataset], tmp_path: Path) -> None:
    with pytest.raises(InputError, match="dataset.root: no such folder: /nowhere"):
        reader("/nowhere")
    with pytest.raises(InputError, match=r"dataset\.(root|num_classes)"):
        reader(str(tmp_path))
    kinds = {MFNet: "mfnet packed", PST900: "pst900", KP: "kp", Freiburg: "freiburg"}
    kind = {**kinds, MVSeg: "mvseg"}[reader]
    root = str(KINDS[kind].write(tmp_path / "data"))
    with pytest.raises(InputError, match="num_classes is 3 but dataset.classes has"):
        reader(root, num_classes=3)
    with pytest.raises(InputError, match="num_classes is 2 but dataset.palette has"):
        reader(root, num_classes=2, classes=("road", "car"))
