from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from analysis.predictions.folder import find
from rgbt.checks import InputError
from rgbt.data.mfnet import MFNet
from rgbt.data.predictions import Affixes

NAMES = ("00001D", "00002N")


def put(folder: Path, *names: str) -> Path:
    folder.mkdir()
    for name in names:
        (folder / name).touch()
    return folder


def test_only_names_of_the_split_are_taken(tiny: MFNet, tmp_path: Path) -> None:
    others = ("00003D.png", "00001D_overlay.png", "notes.txt")
    folder = put(tmp_path / "p", "00002N.png", "00001D.png", *others)
    found = find(folder, tiny, "test", Affixes(), "refuse")
    assert found.paths == {name: folder / f"{name}.png" for name in NAMES}
    assert list(found.paths) == list(NAMES)
    assert found.missing == ()
    assert found.extra == ("00003D",)  # pictures of rgbt.predict are no stray predictions


@pytest.mark.parametrize(
    ("form", "affixes"),
    [("{}_pred.png", ("", "_pred")), ("Pred_rtfnet_{}.png", ("Pred_rtfnet_", ""))],
)
def test_prefix_and_suffix_are_stated(
    tiny: MFNet, tmp_path: Path, form: str, affixes: tuple[str, str]
) -> None:
    folder = put(tmp_path / "p", *map(form.format, NAMES), "00001D_overlay.png", "mean.png")
    found = find(folder, tiny, "test", Affixes(*affixes), "refuse")
    assert found.paths == {name: folder / form.format(name) for name in NAMES}
    assert found.extra == ("mean",)
    with pytest.raises(InputError, match=r"has a file NAME\.png in .*; it contains"):
        find(folder, tiny, "test", Affixes(), "refuse")


def test_missing_files_are_refused_unless_excluded(tiny: MFNet, tmp_path: Path) -> None:
    folder = put(tmp_path / "p", "00001D.png")
    with pytest.raises(InputError, match=r"lacks .* 1 of the 2 .*\(00002N\.png\).*missing=leave"):
        find(folder, tiny, "test", Affixes(), "refuse")
    found = find(folder, tiny, "test", Affixes(), "leave_out")
    assert list(found.paths) == ["00001D"]
    assert found.missing == ("00002N",)


@pytest.mark.parametrize("missing", ["refuse", "leave_out"])
def test_a_wrong_split_is_named(tiny: MFNet, tmp_path: Path, missing: Any) -> None:
    folder = put(tmp_path / "p", "00001D.png", "00002N.png")
    with pytest.raises(InputError, match=r"none of the 1 .*'val'.*, 2 of them .*give split=test"):
        find(folder, tiny, "val", Affixes(), missing)
    with pytest.raises(InputError, match=r"no split 'tset'; did you mean 'test'"):
        find(folder, tiny, "tset", Affixes(), missing)


def test_folders_without_predictions(tiny: MFNet, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"there is no such folder"):
        find(tmp_path / "none", tiny, "test", Affixes(), "refuse")
    with pytest.raises(InputError, match=r"expected PNG files named NAME\.png, but it is empty"):
        find(put(tmp_path / "empty"), tiny, "test", Affixes(), "refuse")
    arrays = put(tmp_path / "npy", *(f"{name}.npy" for name in NAMES))
    with pytest.raises(InputError, match=r"but it contains 00001D\.npy, 00002N\.npy"):
        find(arrays, tiny, "test", Affixes(), "refuse")
    foreign = put(tmp_path / "foreign", "a.png", "b.png", "c.png", "d.png", "e.png")
    with pytest.raises(InputError, match=r"contains a\.png, b\.png, c\.png and 2 more\.$"):
        find(foreign, tiny, "test", Affixes(), "refuse")
