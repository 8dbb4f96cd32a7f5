"""Two streams of batches side by side: independent, resumable, numbered."""

from __future__ import annotations

import dataclasses
import multiprocessing

import pytest
import torch

from rgbt.checks import InputError
from rgbt.data.loaders import LoadedPair, LoaderSettings, PairedBatches, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.transforms.fixed_size import ThesisTransform
from rgbt.types import Batch

DAY = [f"{number:05d}D" for number in range(1, 8)]
NIGHT = [f"{number:05d}N" for number in range(1, 5)]
TRANSFORM = ThesisTransform(
    crop_hw=(24, 32),
    flip_probability=0.5,
    blur_probability=0.5,
    blur_kernel=5,
    label_resize="nearest",
    test_short_edge=24,
    track_position=False,
)


@pytest.fixture
def dataset(write_mfnet) -> MFNet:
    lists = {"train": DAY, "val": NIGHT, "test": DAY[:1]}
    return MFNet(str(write_mfnet(lists)))


def stream(dataset: MFNet, split: str, seed: int, steps: range, **changes: object):
    base = LoaderSettings(batch_size=2, eval_batch_size=2, num_workers=0)
    loading = dataclasses.replace(base, **changes)  # type: ignore[arg-type]
    return train_batches(dataset, split, TRANSFORM, loading, seed, steps)


def pairs(dataset: MFNet, steps: range, per_step: int = 1, **changes: object) -> PairedBatches:
    return PairedBatches(
        stream(dataset, "train", 3, steps, **changes),
        stream(dataset, "val", 4, steps, **changes),
        first=steps.start,
        per_step=per_step,
    )


def assert_equal(one: Batch, other: Batch) -> None:
    for each in dataclasses.fields(Batch):
        a, b = getattr(one, each.name), getattr(other, each.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, each.name


def assert_equal_pairs(one: LoadedPair, other: LoadedPair) -> None:
    assert_equal(one.source, other.source)
    assert_equal(one.target, other.target)
    assert one.step == other.step


def test_starting_later_continues(dataset: MFNet) -> None:
    whole = list(pairs(dataset, range(20)))
    late = list(pairs(dataset, range(10, 20)))
    for one, other in zip(whole[10:], late, strict=True):
        assert_equal_pairs(one, other)
    moved = late[0].to("cpu")
    assert moved.step == late[0].step == 10
    for side in ("source", "target"):
        assert_equal(getattr(moved, side), getattr(late[0], side).to("cpu"))


def test_pairs_of_one_step_have_its_number(dataset: MFNet) -> None:
    found = [pair.step for pair in pairs(dataset, range(6), per_step=3)]
    assert found == [0, 0, 0, 1, 1, 1]
    assert [pair.step for pair in pairs(dataset, range(3, 6), per_step=3)] == [1, 1, 1]


def test_the_same_pairs_whatever_the_workers(dataset: MFNet) -> None:
    for one, other in zip(
        pairs(dataset, range(5)), pairs(dataset, range(5), num_workers=2), strict=True
    ):
        assert_equal_pairs(one, other)


@pytest.mark.parametrize("workers", [0, 2])
def test_unreadable_file_stops_both_domains(dataset: MFNet, workers: int) -> None:
    dataset.files(NIGHT[0])[0].write_bytes(b"damaged")
    found = pairs(dataset, range(4), num_workers=workers)
    with pytest.raises(InputError, match=f"{NIGHT[0]}.png cannot be decoded"):
        list(found)
    assert list(found) == []
    assert multiprocessing.active_children() == []
