from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from analysis.predictions.folder import find
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet

NAMES = ("00001D", "00002N")


def put(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    return folder


def test_only_names_of_the_split_are_taken(tiny: MFNet, tmp_path: Path) -> None:
    others = ("00003D.png", "00001D_overlay.png", "notes.txt")
    folder = put(tmp_path / "p", "00002N.png", "00001D.png", *others)
    found = find(folder, tiny, "test", "", "refuse")
    assert found.paths == {name: folder / f"{name}.png" for name in NAMES}
    assert list(found.paths) == list(NAMES)
    assert found.missing == ()
    assert found.extra == ("00003D",)  # pictures of rgbt.predict are no stray predictions


def test_a_suffix_is_part_of_the_names(tiny: MFNet, tmp_path: Path) -> None:
    folder = put(tmp_path / "p", "00001D_pred.png", "00002N_pred.png")
    found = find(folder, tiny, "test", "_pred", "refuse")
    assert found.paths["00002N"] == folder / "00002N_pred.png"
    with pytest.raises(InputError, match=r"none of the 2 .*00001D_pred\.png.*give suffix=_pred"):
        find(folder, tiny, "test", "", "refuse")


def test_missing_files_are_refused_unless_excluded(tiny: MFNet, tmp_path: Path) -> None:
    folder = put(tmp_path / "p", "00001D.png")
    with pytest.raises(InputError, match=r"lacks .* 1 of the 2 .*\(00002N\.png\).*missing=leave"):
        find(folder, tiny, "test", "", "refuse")
    found = find(folder, tiny, "test", "", "leave_out")
    assert list(found.paths) == ["00001D"]
    assert found.missing == ("00002N",)


@pytest.mark.parametrize("missing", ["refuse", "leave_out"])
def test_a_wrong_split_is_named(tiny: MFNet, tmp_path: Path, missing: Any) -> None:
    folder = put(tmp_path / "p", "00001D.png", "00002N.png")
    with pytest.raises(InputError, match=r"none of the 1 .*'val'.*, 2 of them .*give split=test"):
        find(folder, tiny, "val", "", missing)
    with pytest.raises(InputError, match=r"no split 'tset'; did you mean 'test'"):
        find(folder, tiny, "tset", "", missing)


def test_folders_without_predictions(tiny: MFNet, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no such folder"):
        find(tmp_path / "none", tiny, "test", "", "refuse")
    with pytest.raises(InputError, match=r"expected PNG files named NAME\.png, but it is empty"):
        find(put(tmp_path / "empty"), tiny, "test", "", "refuse")
    arrays = put(tmp_path / "npy", *(f"{name}.npy" for name in NAMES))
    with pytest.raises(InputError, match=r"but it contains 00001D\.npy, 00002N\.npy"):
        find(arrays, tiny, "test", "", "refuse")
    foreign = put(tmp_path / "foreign", "a.png", "b.png", "c.png", "d.png", "e.png")
    with pytest.raises(InputError, match=r"contains a\.png, b\.png, c\.png and 2 more\.$"):
        find(foreign, tiny, "test", "", "refuse")
