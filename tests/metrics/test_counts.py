"""The file of counts: what is written comes back, and what is not one is refused."""

from __future__ import annotations

import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics import archive
from rgbt.metrics.archive import Archive
from rgbt.metrics.counts import Counts, check_same_means, convention
from tests.measured import measurement, remeasured


def example(night: tuple[bool, ...] | None = (False, True, True), **changes: Any) -> Counts:
    rng = np.random.default_rng(0)
    counts = Counts(
        counts=rng.integers(0, 1000, (3, 5, 2, 2)).astype(np.int32),
        names=("00001D", "00002N", "00003N"),
        night=night,
        classes=("unlabeled", "car"),
        measurement=measurement(run="0123456789ab"),
    )
    return replace(counts, **changes)


@pytest.mark.parametrize(
    "counts",
    [
        example(),
        example(None),
        example(unscored=("car",), measurement=measurement(absent="exclude", weights="f" * 64)),
    ],
)
def test_what_is_saved_is_loaded(tmp_path: Path, counts: Counts) -> None:
    counts.save(tmp_path / "test.npz")
    loaded = Counts.load(tmp_path / "test.npz")
    assert np.array_equal(loaded.counts, counts.counts)
    assert loaded.counts.dtype == np.int32
    assert repr(replace(loaded, counts=counts.counts)) == repr(counts)
    assert [path.name for path in tmp_path.iterdir()] == ["test.npz"]


def test_sums_do_not_overflow_the_type_of_the_file() -> None:
    huge = example(counts=np.full((3, 5, 2, 2), 2**30, np.int32))
    assert huge.whole()[0, 0] == 15 * 2**30
    assert huge.by_region()[0, 0, 0] == 3 * 2**30
    assert np.array_equal(example().by_region()[3], example().counts[:, 3].sum(0))


def test_neighbours_are_added_and_day_and_night_stay_apart() -> None:
    night = (False, True, False, True, False, True, True)
    array = np.random.default_rng(1).integers(0, 1000, (7, 5, 2, 2)).astype(np.int32)
    counts = replace(example(unscored=("car",)), counts=array, names=tuple("abcdefg"), night=night)
    added = counts.added(2)
    assert added.names == ("a+1", "e+0", "b+1", "f+1")
    assert added.night == (False, False, True, True)
    sums = array[[0, 4, 1, 5]] + np.stack([array[2], 0 * array[0], array[3], array[6]])
    assert np.array_equal(added.counts, sums)
    assert added.counts.dtype == np.int32
    assert added.unscored == ("car",)
    assert counts.added(1) is counts
    unknown = replace(counts, night=None).added(3)
    assert (unknown.names, unknown.night) == (("a+2", "d+2", "g+0"), None)
    assert np.array_equal(unknown.whole(), counts.whole())


def test_selected_images_keep_their_order_and_time() -> None:
    chosen = example(unscored=("car",)).select(["00003N", "00001D"])
    assert chosen.names == ("00003N", "00001D")
    assert chosen.night == (True, False)
    assert chosen.unscored == ("car",)
    assert np.array_equal(chosen.counts, example().counts[[2, 0]])
    with pytest.raises(InputError, match="'test': image '00009N'"):
        example().select(["00009N"])


def test_day_and_night() -> None:
    parts = example().parts()
    assert parts["day"].names == ("00001D",)
    assert parts["night"].names == ("00002N", "00003N")
    assert np.array_equal(parts["day"].whole() + parts["night"].whole(), example().whole())
    assert example(None).parts() == {}
    assert example((True, True, True)).parts() == {}


def test_counts_of_other_means_or_conventions_are_not_compared() -> None:
    check_same_means(example(unscored=("car",)), example(unscored=("car",)))
    with pytest.raises(InputError, match=r"leave out car .* leave out no class\. .*unscored"):
        check_same_means(example(unscored=("car",)), example())
    both = [remeasured(example(), absent=absent) for absent in ("released", "exclude")]
    assert convention(both[1:]) == "exclude"
    with pytest.raises(InputError, match="Choose absent=released or absent=exclude"):
        convention(both)


def test_other_files_are_refused_and_nothing_in_them_runs(tmp_path: Path) -> None:
    path = tmp_path / "counts.npz"
    changes: dict[str, Callable[[dict[str, Any]], Any]] = {
        "does not match its digest": lambda a: a["counts"].__iadd__(1),
        "digest": lambda a: a.pop("digest"),
        "Object arrays": lambda a: a.update(bad=np.array([{}], object)),
    }
    for said, change in changes.items():
        example().save(path)
        with np.load(path) as stored:
            arrays = {name: stored[name] for name in stored.files}
        change(arrays)
        np.savez_compressed(path, **arrays)
        with pytest.raises(InputError, match=f"not a readable file of counts.*{said}"):
            Counts.load(path)
    Archive("rgbt maps 1", "maps", "x").save(path, {})
    with pytest.raises(InputError, match="expected the mark 'rgbt counts 3', got 'rgbt maps 1'"):
        Counts.load(path)
    with pytest.raises(InputError, match="the file of counts .* does not exist"):
        Counts.load(tmp_path / "none.npz")


def test_a_file_of_too_many_bytes_is_refused_before_they_are_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    example().save(tmp_path / "counts.npz")
    with zipfile.ZipFile(tmp_path / "counts.npz") as file:
        size = sum(member.file_size for member in file.infolist())
    monkeypatch.setattr(archive, "MAX_BYTES", size)
    assert Counts.load(tmp_path / "counts.npz").names == example().names
    monkeypatch.setattr(archive, "MAX_BYTES", size - 1)
    monkeypatch.setattr(np.lib.npyio.NpzFile, "__getitem__", None)
    with pytest.raises(InputError, match="it holds"):
        Counts.load(tmp_path / "counts.npz")
