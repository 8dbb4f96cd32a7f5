from __future__ import annotations

import os

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.archive import Archive

KIND = Archive("rgbt things 1", "things", "make it with make-things")


def test_what_is_saved_is_loaded_with_its_mark(tmp_path) -> None:
    KIND.save(tmp_path / "a.npz", {"numbers": np.arange(3), "name": np.array("x")})
    values = KIND.load(tmp_path / "a.npz")
    np.testing.assert_array_equal(values["numbers"], [0, 1, 2])
    assert str(values["name"]) == "x"
    assert str(values["format"]) == "rgbt things 1"
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]


def test_pickles_are_not_read(tmp_path) -> None:
    np.savez(tmp_path / "a.npz", format=np.array(KIND.mark), bad=np.array([{}], object))
    with pytest.raises(InputError, match="not a readable file of things; make it with make-things"):
        KIND.load(tmp_path / "a.npz")


def test_other_kinds_are_refused(tmp_path) -> None:
    Archive("rgbt things 2", "things", "x").save(tmp_path / "a.npz", {})
    with pytest.raises(InputError, match="expected the mark 'rgbt things 1', got 'rgbt things 2'"):
        KIND.load(tmp_path / "a.npz")
    with pytest.raises(InputError, match="there is no file of things"):
        KIND.load(tmp_path / "none.npz")


def test_a_file_that_may_not_be_read_is_said(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    KIND.save(tmp_path / "a.npz", {})
    monkeypatch.setattr(os, "access", lambda path, mode: mode != os.R_OK)  # root may read anything
    with pytest.raises(InputError, match="may not be read; change its permissions"):
        KIND.load(tmp_path / "a.npz")
