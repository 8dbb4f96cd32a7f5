from __future__ import annotations

import dataclasses
import logging
import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from rgbt.checks import InputError, RunError
from rgbt.data import loaders
from rgbt.data.loaders import (
    LoadedBatch,
    LoaderSettings,
    collate,
    eval_batches,
    steps_per_epoch,
    train_batches,
)
from rgbt.data.mfnet import MFNet
from rgbt.transforms.crm import CrmTransform
from rgbt.types import Batch, Sample
from tests.transforms import recipes

NAMES = [f"{number:05d}{'DN'[number % 2]}" for number in range(1, 11)]


def crm(**changes: object) -> CrmTransform:
    return recipes.crm(**{"sizes": (16, 24, 40), "crop_hw": (12, 16), **changes})


def settings(**changes: object) -> LoaderSettings:
    base = LoaderSettings(batch_size=4, eval_batch_size=3, num_workers=0)
    return dataclasses.replace(base, **changes)  # type: ignore[arg-type]


@pytest.fixture
def dataset(write_mfnet) -> MFNet:
    return MFNet(str(write_mfnet({"train": NAMES, "val": NAMES[:5]})))


def damage(dataset: MFNet, name: str) -> None:
    dataset.files(name)[0].write_bytes(b"damaged")


def assert_equal(one: Batch, other: Batch) -> None:
    for each in dataclasses.fields(Batch):
        a, b = getattr(one, each.name), getattr(other, each.name)
        assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, each.name


def test_same_batches_whatever_the_workers(dataset: MFNet) -> None:
    runs = [
        list(train_batches(dataset, "train", crm(), settings(num_workers=n), 7, range(5)))
        for n in (0, 1, 2)
    ]
    for one, *others in zip(*runs, strict=True):
        for other in others:
            assert_equal(one, other)


def test_starting_later_gives_the_same_batches(dataset: MFNet) -> None:
    """Steps 3 and 4 lie in another epoch (two whole batches per epoch), with workers or without."""
    whole = list(train_batches(dataset, "train", crm(), settings(), 7, range(6)))
    for workers in (0, 2):
        changed = settings(num_workers=workers)
        late = list(train_batches(dataset, "train", crm(), changed, 7, range(3, 6)))
        for one, other in zip(whole[3:], late, strict=True):
            assert_equal(one, other)


def test_epochs_are_permutations_and_seeds_differ(dataset: MFNet) -> None:
    def order(seed: int) -> list[str]:
        whole = settings(batch_size=5)
        batches = train_batches(dataset, "train", crm(), whole, seed, range(4))
        return [name for batch in batches for name in batch.name]

    first = order(0)
    assert sorted(first[:10]) == sorted(first[10:]) == NAMES
    assert first[:10] != first[10:]
    assert order(0) == first
    assert order(1) != first


def test_augmentation_differs_between_epochs(dataset: MFNet) -> None:
    whole = settings(batch_size=10)
    one, other = train_batches(dataset, "train", crm(), whole, 0, range(2))
    same = [one.name.index(name) for name in other.name]
    assert not torch.equal(one.rgb[same], other.rgb)


def test_loading_leaves_the_global_generators_alone(dataset: MFNet) -> None:
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    for workers in (0, 1):
        changed = settings(num_workers=workers)
        list(train_batches(dataset, "train", crm(), changed, 0, range(1)))
    assert torch.equal(torch.get_rng_state(), torch_state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)


def test_evaluation_in_list_order(dataset: MFNet) -> None:
    batches = list(eval_batches(dataset, "val", crm(test_short_edge=12), settings()))
    assert [batch.name for batch in batches] == [tuple(NAMES[:3]), tuple(NAMES[3:5])]
    assert batches[0].rgb.shape == (3, 3, 12, 16)
    assert batches[0].label.shape == (3, 24, 32)
    np.testing.assert_array_equal(batches[1].label[0].numpy(), dataset.read(NAMES[3]).label)


def test_sizes_that_differ(dataset: MFNet, expected_pair, png) -> None:
    rgb, thermal, label = expected_pair(NAMES[1], (20, 32))
    png(dataset.files(NAMES[1])[0], np.dstack([rgb, thermal]))
    png(dataset.files(NAMES[1])[-1], label)
    with pytest.raises(InputError, match=r"24x32 \('00001N'\) and 20x32 .*eval_batch_size=1"):
        next(eval_batches(dataset, "val", crm(), settings()))
    batches = list(eval_batches(dataset, "val", crm(), settings(eval_batch_size=1)))
    assert len(batches) == 5
    transform = crm(sizes=None, crop_hw=None)
    with pytest.raises(InputError, match="choose a transform.crop_hw"):
        list(train_batches(dataset, "train", transform, settings(), 0, range(2)))


@pytest.mark.parametrize("workers", [0, 2])
def test_nothing_comes_after_close(dataset: MFNet, workers: int) -> None:
    changed = settings(num_workers=workers)
    batches = train_batches(dataset, "train", crm(), changed, 0, range(4))
    next(batches)
    batches.close()
    assert list(batches) == []
    assert multiprocessing.active_children() == []


def test_steps_per_epoch(dataset: MFNet) -> None:
    assert steps_per_epoch(dataset, settings()) == 2
    assert steps_per_epoch(dataset, settings(batch_size=10)) == 1
    assert steps_per_epoch(dataset, settings(batch_size=2), "val") == 2
    with pytest.raises(InputError, match="is 11 but split 'train' of mfnet has only 10"):
        steps_per_epoch(dataset, settings(batch_size=11))
    with pytest.raises(InputError, match="lower data.batch_size"):
        train_batches(dataset, "train", crm(), settings(batch_size=11), 0, range(1))


@pytest.mark.parametrize("workers", [0, 2])
def test_raise_names_the_damaged_file(dataset: MFNet, workers: int) -> None:
    damage(dataset, NAMES[4])
    changed = settings(num_workers=workers)
    with pytest.raises(InputError, match=rf"^\S*images/{NAMES[4]}.png cannot be decoded") as info:
        list(train_batches(dataset, "train", crm(), changed, 0, range(4)))
    assert "Traceback" not in str(info.value)
    assert multiprocessing.active_children() == []
    with pytest.raises(InputError, match=rf"images/{NAMES[4]}.png cannot be decoded"):
        list(eval_batches(dataset, "val", crm(), changed))


@pytest.mark.parametrize("workers", [0, 2])
def test_skip_in_training_reads_next_name(
    dataset: MFNet, workers: int, caplog: pytest.LogCaptureFixture
) -> None:
    intact = list(train_batches(dataset, "train", crm(), settings(), 0, range(4)))
    damage(dataset, NAMES[4])
    damage(dataset, NAMES[5])
    changed = settings(num_workers=workers, on_error="skip")
    with caplog.at_level(logging.WARNING):
        batches = train_batches(dataset, "train", crm(), changed, 0, range(4))
        found = list(batches)
    replaced = {NAMES[4]: NAMES[6], NAMES[5]: NAMES[6]}
    for one, other in zip(intact, found, strict=True):
        assert other.name == tuple(replaced.get(name, name) for name in one.name)
    assert set(batches.skipped) == {NAMES[4], NAMES[5]}
    assert "cannot be decoded" in batches.skipped[NAMES[4]]
    named = [record.getMessage() for record in caplog.records]
    assert sum(f"'{NAMES[4]}'" in message for message in named) == 1


def test_skip_wraps_around_the_list(dataset: MFNet) -> None:
    damage(dataset, NAMES[-1])
    whole = settings(batch_size=10, on_error="skip")
    batch = next(train_batches(dataset, "train", crm(), whole, 0, range(1)))
    assert sorted(batch.name) == sorted([*NAMES[:-1], NAMES[0]])


@pytest.mark.parametrize("workers", [0, 2])
def test_skip_in_evaluation_leaves_out(dataset: MFNet, workers: int) -> None:
    for name in (NAMES[1], NAMES[3], NAMES[4]):
        damage(dataset, name)
    batches = eval_batches(
        dataset, "val", crm(), settings(num_workers=workers, on_error="skip", eval_batch_size=3)
    )
    # The second batch would be empty and does not come at all.
    assert [batch.name for batch in batches] == [(NAMES[0], NAMES[2])]
    assert set(batches.skipped) == {NAMES[1], NAMES[3], NAMES[4]}


def test_skip_with_nothing_left(dataset: MFNet) -> None:
    for name in NAMES:
        damage(dataset, name)
    batches = train_batches(dataset, "train", crm(), settings(on_error="skip"), 0, range(1))
    with pytest.raises(InputError, match="none of the 10 training samples of mfnet can be read"):
        next(batches)


def confident(sample: Sample, value: float | None) -> Sample:
    assert sample.label is not None
    full = None if value is None else np.full(sample.label.shape, value, np.float32)
    return dataclasses.replace(sample, confidence=full)


def test_confidences_are_stacked_for_all_or_none(dataset: MFNet) -> None:
    first, second = (dataset.read(name) for name in NAMES[:2])

    def batch(*values: float | None) -> Batch:
        pairs = zip((first, second), values, strict=True)
        return collate([crm().test(confident(sample, value)) for sample, value in pairs])

    found = batch(0.25, 0.75).confidence
    assert found is not None
    assert found.dtype == torch.float32
    assert found.shape == batch(0.25, 0.75).label.shape
    assert found.flatten(1).unique(dim=1).tolist() == [[0.25], [0.75]]
    assert batch(None, None).confidence is None
    message = (
        f"all labels of one batch must carry confidences, or none; '{NAMES[0]}' and '{NAMES[1]}'"
    )
    with pytest.raises(InputError, match=message):
        batch(None, 0.75)


def test_full_shared_memory_is_reported(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("unable to allocate shared memory(shm): No space left on device (28)")

    monkeypatch.setattr(torch.Tensor, "share_memory_", refuse)  # inherited by the workers
    batches = train_batches(dataset, "train", crm(), settings(num_workers=2), 0, range(2))
    with pytest.raises(InputError, match=r"/dev/shm .*No space left.*--shm-size.*num_workers=0"):
        next(batches)


def test_killed_worker_is_reported(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    main = os.getpid()

    def die(_: str) -> Sample:
        assert os.getpid() != main, "only a worker is to die"
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("a killed process does nothing more")

    monkeypatch.setattr(dataset, "read", die)
    batches = train_batches(dataset, "train", crm(), settings(num_workers=1), 0, range(2))
    with pytest.raises(RunError, match=r"loader process died .*memory.*data\.num_workers"):
        next(batches)


@pytest.mark.parametrize(("workers", "ahead"), [(0, None), (2, 5)])
@pytest.mark.parametrize("gpu", [False, True])
def test_batches_are_prefetched_and_pinned(
    dataset: MFNet, monkeypatch: pytest.MonkeyPatch, workers: int, ahead: int | None, gpu: bool
) -> None:
    """Batches ahead of the one that is used, and pinned where there is a GPU to copy them to."""
    batch = next(train_batches(dataset, "train", crm(), settings(), 0, range(1)))
    requested: dict[str, object] = {}

    def loader(reader: object, **words: object) -> list[object]:
        requested.update(words)
        return []

    monkeypatch.setattr(loaders, "DataLoader", loader)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert not list(eval_batches(dataset, "val", crm(), settings(num_workers=workers, prefetch=5)))
    assert (requested["num_workers"], requested["prefetch_factor"]) == (workers, ahead)
    assert requested["pin_memory"] is gpu
    locked: list[torch.Tensor] = []  # pages are locked on machines with a GPU alone
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: locked.append(self) or self)
    LoadedBatch(batch).pin_memory()
    assert len(locked) == sum(isinstance(each, torch.Tensor) for each in vars(batch).values())
    assert LoadedBatch(error="why").pin_memory().error == "why"
