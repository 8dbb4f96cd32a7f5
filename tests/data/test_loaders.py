from __future__ import annotations

import dataclasses
import errno
import logging
import multiprocessing
import os
import signal

import numpy as np
import pytest
import torch

from rgbt.checks import InputError, RunError
from rgbt.data import loaders
from rgbt.data.batches import collate
from rgbt.data.loaders import LoaderSettings, eval_batches, steps_per_epoch, train_batches
from rgbt.data.mfnet import MFNet
from rgbt.data.reader import LoadedBatch
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


def test_shapes_and_dtypes(dataset: MFNet) -> None:
    batch = next(train_batches(dataset, "train", crm(), settings(), 0, range(1)))
    assert batch.position is not None
    shapes = [batch.rgb.shape, batch.thermal.shape, batch.label.shape, batch.position.shape]
    assert [tuple(shape) for shape in shapes] == [
        (4, 3, 12, 16),
        (4, 1, 12, 16),
        (4, 12, 16),
        (4, 2, 12, 16),
    ]
    assert (batch.rgb.dtype, batch.thermal.dtype) == (torch.uint8, torch.uint8)
    assert (batch.label.dtype, batch.position.dtype) == (torch.uint8, torch.float32)
    assert batch.to("cpu").label.dtype == torch.int64
    assert (batch.centre_yx.dtype, batch.original_hw.dtype) == (torch.int64, torch.int64)
    assert batch.original_hw.tolist() == [[24, 32]] * 4
    assert batch.rgb.is_contiguous()


def test_label_comes_from_the_position(dataset: MFNet, expected_pair) -> None:
    """Through the whole chain, batch and all: label[crop] == label of the file[position]."""
    for batch in train_batches(dataset, "train", crm(), settings(), 3, range(4)):
        assert batch.position is not None
        for index, name in enumerate(batch.name):
            label = torch.from_numpy(expected_pair(name, (24, 32))[2]).long()
            row, column = batch.position[index].long()
            assert torch.equal(batch.label[index], label[row, column])


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


@pytest.mark.parametrize("cache", ["", " ", "none", "None", "null", "false", False])
def test_invalid_cache_folder_is_refused(cache: object) -> None:
    """They would be folders where the command was typed."""
    sentence = (
        rf"^data\.cache: {cache!r} is not a folder; expected auto or a folder \(write \./NAME .*"
    )
    with pytest.raises(InputError, match=sentence):
        settings(cache=cache)
    for known in (None, "auto", "./none", "/fast/disk"):
        assert settings(cache=known).cache == known


@pytest.mark.parametrize(
    ("workers", "ahead", "gpu"), [(0, None, True), (2, 5, True), (2, 5, False)]
)
def test_arguments_of_the_loader(
    dataset: MFNet, monkeypatch: pytest.MonkeyPatch, workers: int, ahead: int | None, gpu: bool
) -> None:
    """Batches ahead of the one that is used, and pinned where there is a GPU to copy them to."""
    requested: dict[str, object] = {}

    def loader(reader: object, **words: object) -> list[object]:
        requested.update(words)
        return []

    monkeypatch.setattr(loaders, "DataLoader", loader)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    changed = settings(num_workers=workers, prefetch=5)
    assert list(eval_batches(dataset, "val", crm(), changed)) == []
    assert (requested["num_workers"], requested["prefetch_factor"]) == (workers, ahead)
    assert requested["pin_memory"] is gpu


def test_all_of_a_batch_is_pinned(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pages are locked on machines with a GPU alone."""
    locked: dict[int, torch.Tensor] = {}

    def lock(tensor: torch.Tensor) -> torch.Tensor:
        copy = tensor.clone()
        locked[id(copy)] = copy
        return copy

    monkeypatch.setattr(torch.Tensor, "pin_memory", lock)
    batch = next(train_batches(dataset, "train", crm(), settings(), 0, range(1)))
    pinned = LoadedBatch(batch, {"x": "why"}).pin_memory()
    assert pinned.skipped == {"x": "why"}
    assert isinstance(pinned.batch, type(batch))
    values = {each.name: getattr(pinned.batch, each.name) for each in dataclasses.fields(batch)}
    tensors = {name for name, value in values.items() if isinstance(value, torch.Tensor)}
    assert {"rgb", "thermal", "label", "original_hw"} < tensors
    assert {name for name, value in values.items() if id(value) in locked} == tensors
    assert_equal(batch.to("cpu"), pinned.batch.to("cpu"))
    empty = LoadedBatch(error="why")
    assert empty.pin_memory() is empty


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
    message = f"Those of '{NAMES[1]}' do and those of '{NAMES[0]}' do not"
    with pytest.raises(InputError, match=message):
        batch(None, 0.75)


def test_full_shared_memory_is_reported(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("unable to allocate shared memory(shm): No space left on device (28)")

    monkeypatch.setattr(torch.Tensor, "share_memory_", refuse)  # inherited by the workers
    batches = train_batches(dataset, "train", crm(), settings(num_workers=2), 0, range(2))
    with pytest.raises(InputError, match=r"/dev/shm .*No space left.*--shm-size.*num_workers=0"):
        next(batches)


def test_full_shared_memory_before_start_is_reported(
    dataset: MFNet, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(loaders.multiprocessing, "Lock", refuse)
    with pytest.raises(InputError, match=r"/dev/shm .*num_workers=0") as caught:
        train_batches(dataset, "train", crm(), settings(num_workers=2), 0, range(2))
    assert caught.value.__suppress_context__, "caught once, not as a full disk as well"


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
