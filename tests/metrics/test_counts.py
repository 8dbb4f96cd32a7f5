"""The file of counts: what is written comes back, and what is not one is refused."""

from __future__ import annotations

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts


def example(night: tuple[bool, ...] | None = (False, True, True)) -> Counts:
    rng = np.random.default_rng(0)
    return Counts(
        counts=rng.integers(0, 1000, (3, 5, 2, 2)).astype(np.int32),
        names=("00001D", "00002N", "00003N"),
        night=night,
        classes=("unlabeled", "car"),
        partition="ring5",
        dataset="abc",
        split="test",
    )


@pytest.mark.parametrize("night", [None, (False, True, True)])
def test_what_is_saved_is_loaded(tmp_path, night) -> None:
    counts = example(night)
    counts.save(tmp_path / "test.npz")
    loaded = Counts.load(tmp_path / "test.npz")
    assert np.array_equal(loaded.counts, counts.counts)
    assert loaded.counts.dtype == np.int32
    for key in ("names", "night", "classes", "partition", "dataset", "split"):
        assert getattr(loaded, key) == getattr(counts, key)
        assert type(getattr(loaded, key)) is type(getattr(counts, key))
    assert [path.name for path in tmp_path.iterdir()] == ["test.npz"]


def test_sums_over_images_and_regions() -> None:
    counts = example()
    assert counts.by_region().shape == (5, 2, 2)
    assert np.array_equal(counts.by_region()[3], counts.counts[:, 3].sum(0))
    assert np.array_equal(counts.whole(), counts.counts.sum((0, 1)))
    assert counts.whole().dtype == np.int64


def test_sums_do_not_overflow_the_type_of_the_file() -> None:
    counts = example()
    huge = Counts(**{**vars(counts), "counts": np.full((3, 5, 2, 2), 2**30, np.int32)})
    assert huge.whole()[0, 0] == 15 * 2**30


def test_selected_images_keep_their_order_and_time() -> None:
    chosen = example().select(["00003N", "00001D"])
    assert chosen.names == ("00003N", "00001D")
    assert chosen.night == (True, False)
    assert np.array_equal(chosen.counts, example().counts[[2, 0]])
    with pytest.raises(InputError, match=r"'00009N'.*split 'test'"):
        example().select(["00009N"])


def test_day_and_night() -> None:
    parts = example().parts()
    assert parts["day"].names == ("00001D",)
    assert parts["night"].names == ("00002N", "00003N")
    assert np.array_equal(parts["day"].whole() + parts["night"].whole(), example().whole())
    assert example(None).parts() == {}
    assert example((True, True, True)).parts() == {}


def test_lengths_must_agree() -> None:
    values = vars(example())
    with pytest.raises(ValueError, match="N=2"):
        Counts(**{**values, "names": ("a", "b"), "night": None})
    with pytest.raises(ValueError, match="K=1"):
        Counts(**{**values, "classes": ("a",)})
    with pytest.raises(ValueError, match="night"):
        Counts(**{**values, "night": (True,)})


def test_a_file_that_is_not_one_is_refused_in_a_sentence(tmp_path) -> None:
    with pytest.raises(InputError, match="the file of counts .* does not exist"):
        Counts.load(tmp_path / "none.npz")
    text, empty = tmp_path / "text.npz", tmp_path / "empty.npz"
    text.write_text("not counts")
    empty.write_bytes(b"")
    for path in (text, empty):
        with pytest.raises(InputError, match="not a readable file of counts"):
            Counts.load(path)
    example().save(tmp_path / "whole.npz")
    cut = tmp_path / "cut.npz"
    cut.write_bytes((tmp_path / "whole.npz").read_bytes()[:-40])
    with pytest.raises(InputError, match="not a readable file of counts"):
        Counts.load(cut)
    np.savez(tmp_path / "other.npz", values=np.zeros(3))
    np.save(tmp_path / "array.npz.npy", np.zeros(3))
    for name in ("other.npz", "array.npz.npy"):
        with pytest.raises(InputError, match="file of counts"):
            Counts.load(tmp_path / name)
    np.savez(tmp_path / "pickle.npz", format=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="not a readable file of counts"):
        Counts.load(tmp_path / "pickle.npz")
