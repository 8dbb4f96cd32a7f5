from __future__ import annotations

import io
import os
import zipfile

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.archive import Archive
from rgbt.metrics.counts import Counts

KIND = Archive(
    "rgbt things 1", "things", "make it", {"numbers": "iu N", "name": "U"}, ("numbers", "name")
)


def test_what_is_saved_is_loaded_with_its_mark(tmp_path) -> None:
    KIND.save(tmp_path / "a.npz", {"numbers": np.arange(3), "name": np.array("x")})
    values = KIND.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(values["numbers"], [0, 1, 2])
    assert str(values["name"]) == "x"
    assert str(values["format"]) == "rgbt things 1"
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_pickles_are_not_read(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", format=np.array(KIND.mark), bad=np.array([{}], object))
    with pytest.raises(
        InputError, match=r"not a readable file of things \(Object arrays.*\); make it"
    ):
        KIND.load(tmp_path / "a.npz")


def test_other_kinds_are_refused(tmp_path) -> None:
    Archive("rgbt things 2", "things", "x", {}).save(tmp_path / "a.npz", {})
    with pytest.raises(InputError, match="expected the mark 'rgbt things 1', got 'rgbt things 2'"):
        KIND.load(tmp_path / "a.npz")
    with pytest.raises(InputError, match="the file of things .* does not exist"):
        KIND.load(tmp_path / "none.npz")


def test_a_file_that_may_not_be_read_is_said(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    KIND.save(tmp_path / "a.npz", {})
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.R_OK)  # root may read anything
    with pytest.raises(
        InputError, match="cannot be read: permission denied; change its permissions"
    ):
        KIND.load(tmp_path / "a.npz")


def counts_of(path, images: int, classes: int = 3):
    """Counts that agree with each other, mostly zeros, so that they are packed a thousandfold."""
    values = Counts(
        counts=np.zeros((images, 9, classes, classes), np.int64),
        names=tuple(map(str, range(images))),
        night=None,
        classes=tuple(map(str, range(classes))),
        partition="ring9",
        dataset="0",
        split="test",
    )
    values.save(path)
    return path


def rewritten(path, change) -> None:
    """The archive with its arrays changed, as a stranger would write it."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    np.savez_compressed(path, **change(arrays))


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda a: {**a, "counts": np.zeros((4, 9, 3, 3), int)}, "'names' has the unexpected"),
        (lambda a: {**a, "more": np.zeros(3)}, "'more' has the unexpected shape"),
        (lambda a: {**a, "names": np.arange(2)}, "'names' has the unexpected shape"),
        (lambda a: {k: v for k, v in a.items() if k != "night"}, "'night' is missing"),
        (lambda a: {**a, "counts": a["counts"] + 1}, "its content does not match its digest"),
        (lambda a: {**a, "unscored": np.array(["0", "1", "2"])}, (
            "its content does not match its digest"
)),
        (lambda a: {**{k: v for k, v in a.items() if k != "digest"}, "unscored": np.array(["x"])},
         "unscored: expected some, but not all, of the classes"),
        (lambda a: a | {"n": np.zeros(1)}, "'n' has the unexpected shape"),
    ],
)  # fmt: skip
def test_another_content_than_the_kind_has_is_refused(tmp_path, change, reason) -> None:
    path = counts_of(tmp_path / "c.npz", images=2)
    rewritten(path, change)
    with pytest.raises(InputError, match=reason):
        Counts.load(path)


def test_a_header_that_announces_more_than_there_is_allocates_nothing(tmp_path) -> None:
    path = counts_of(tmp_path / "c.npz", images=2)
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        content, {"descr": "<i8", "fortran_order": False, "shape": (2, 9, 1500, 1500)}
    )
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(tmp_path / "d.npz", "w") as new:
        for name in old.namelist():
            new.writestr(name, content.getvalue() if name == "counts.npy" else old.read(name))
    with pytest.raises(InputError, match="reading array data"):
        Counts.load(tmp_path / "d.npz")


def test_files_of_before_the_digest_are_read(tmp_path) -> None:
    path = counts_of(tmp_path / "c.npz", images=2)
    rewritten(path, lambda a: {k: v for k, v in a.items() if k not in ("digest", "unscored")})
    assert Counts.load(path).unscored == ()
