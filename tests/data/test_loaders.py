"""Batches: the same whatever the workers and the first step, in pairs, and drawn by classes."""

from __future__ import annotations

import dataclasses
import logging
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.checks import InputError, RunError
from rgbt.data import loaders
from rgbt.data.loaders import (
    Batches,
    Examples,
    LoadedBatch,
    LoaderSettings,
    PairedBatches,
    collate,
    eval_batches,
    steps_per_epoch,
    train_batches,
)
from rgbt.data.mfnet import MFNet
from rgbt.data.rare_classes import (
    RareClasses,
    class_probabilities,
    count_rare_classes,
)
from rgbt.randomness import numpy_generator
from rgbt.transforms.crm import CrmTransform
from rgbt.types import Batch, Sample
from tests.data.layouts import refused
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


def trained(
    dataset: MFNet, steps: range, seed: int = 7, split: str = "train", **changes: object
) -> Batches:
    return train_batches(dataset, split, crm(), settings(**changes), seed, steps)


def evaluated(dataset: MFNet, **changes: object) -> Batches:
    return eval_batches(dataset, dataset.names("val"), crm(test_short_edge=12), settings(**changes))


def paired(
    dataset: MFNet, steps: range, per_step: int = 1, split: str = "val", **changes: object
) -> PairedBatches:
    """The target is a shorter list, which is shuffled again at its end."""
    changes = {"batch_size": 2, **changes}
    source = trained(dataset, steps, **changes)
    target = trained(dataset, steps, 8, split, **changes)
    return PairedBatches(source, target, first=steps.start, per_step=per_step)


def damage(dataset: MFNet, *names: str) -> None:
    for name in names:
        dataset.files(name)[0].write_bytes(b"damaged")


def assert_equal(found: Iterable[Any], expected: Iterable[Any]) -> None:
    for one, other in zip(found, expected, strict=True):
        for field in dataclasses.fields(one):
            a, b = getattr(one, field.name), getattr(other, field.name)
            if dataclasses.is_dataclass(a):
                assert_equal([a], [b])
            else:
                assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, field.name


@pytest.mark.parametrize("workers", [1, 2])
@pytest.mark.parametrize("make", [trained, paired])
def test_same_batches_whatever_the_workers(
    dataset: MFNet, make: Callable[..., Any], workers: int
) -> None:
    assert_equal(make(dataset, range(5), num_workers=workers), make(dataset, range(5)))


@pytest.mark.parametrize("make", [trained, paired])
def test_starting_later_gives_the_same_batches(dataset: MFNet, make: Callable[..., Any]) -> None:
    """Steps 3 to 5 lie in another epoch, with workers or without."""
    whole = list(make(dataset, range(6)))
    for workers in (0, 2):
        assert_equal(make(dataset, range(3, 6), num_workers=workers), whole[3:])


def test_epochs_are_permutations_and_seeds_differ(dataset: MFNet) -> None:
    def order(seed: int) -> list[str]:
        batches = trained(dataset, range(4), seed, batch_size=5)
        return [name for batch in batches for name in batch.name]

    first = order(0)
    assert sorted(first[:10]) == sorted(first[10:]) == NAMES
    assert first[:10] != first[10:]
    assert order(0) == first
    assert order(1) != first


def test_augmentation_differs_between_epochs(dataset: MFNet) -> None:
    one, other = trained(dataset, range(2), batch_size=10)
    same = [one.name.index(name) for name in other.name]
    assert not torch.equal(one.rgb[same], other.rgb)


def test_loading_leaves_the_global_generators_alone(dataset: MFNet) -> None:
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()
    for workers in (0, 1):
        list(trained(dataset, range(1), num_workers=workers))
    assert torch.equal(torch.get_rng_state(), torch_state)
    np.testing.assert_array_equal(np.random.get_state()[1], numpy_state)


def test_evaluation_in_list_order(dataset: MFNet) -> None:
    batches = list(evaluated(dataset))
    assert [batch.name for batch in batches] == [tuple(NAMES[:3]), tuple(NAMES[3:5])]
    assert batches[0].rgb.shape == (3, 3, 12, 16)
    assert batches[0].label.shape == (3, 24, 32)
    np.testing.assert_array_equal(batches[1].label[0].numpy(), dataset.read(NAMES[3]).label)


def test_sizes_that_differ(dataset: MFNet, expected_pair, png) -> None:
    rgb, thermal, label = expected_pair(NAMES[1], (20, 32))
    png(dataset.files(NAMES[1])[0], np.dstack([rgb, thermal]))
    png(dataset.files(NAMES[1])[-1], label)
    whole = crm(sizes=None, crop_hw=None)
    said = refused(lambda: next(eval_batches(dataset, dataset.names("val"), whole, settings())))
    assert "24x32 ('00001N') and 20x32 ('00002D'); set data.eval_batch_size=1" in said
    assert len(list(evaluated(dataset, eval_batch_size=1))) == 5
    batches = train_batches(dataset, "train", whole, settings(), 0, range(2))
    assert "choose a transform.crop_hw" in refused(lambda: list(batches))


def test_steps_per_epoch(dataset: MFNet) -> None:
    assert steps_per_epoch(dataset, settings()) == 2
    assert steps_per_epoch(dataset, settings(batch_size=2), "val") == 2
    said = refused(lambda: trained(dataset, range(1), batch_size=11))
    assert "is 11 but split 'train' of mfnet has only 10 names; lower data.batch_size" in said


@pytest.mark.parametrize("workers", [0, 2])
def test_unreadable_file_stops_every_stream(dataset: MFNet, workers: int) -> None:
    damage(dataset, NAMES[4])
    for batches in (
        trained(dataset, range(4), num_workers=workers),
        evaluated(dataset, num_workers=workers),
        paired(dataset, range(4), num_workers=workers),
    ):
        with pytest.raises(InputError, match=rf"^\S*images/{NAMES[4]}.png cannot be dec") as info:
            list(batches)
        assert "Traceback" not in str(info.value)
        assert list(batches) == []
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("workers", [0, 2])
def test_skip_in_training_reads_next_name(
    dataset: MFNet, workers: int, caplog: pytest.LogCaptureFixture
) -> None:
    intact = list(trained(dataset, range(4), batch_size=10))
    replaced = {NAMES[4]: NAMES[6], NAMES[5]: NAMES[6], NAMES[9]: NAMES[0]}
    damage(dataset, *replaced)
    with caplog.at_level(logging.WARNING):
        batches = trained(dataset, range(4), batch_size=10, num_workers=workers, on_error="skip")
        found = list(batches)
    for one, other in zip(intact, found, strict=True):
        assert other.name == tuple(replaced.get(name, name) for name in one.name)
    assert set(batches.skipped) == set(replaced)
    assert "cannot be decoded" in batches.skipped[NAMES[4]]
    named = [record.getMessage() for record in caplog.records]
    assert sum(f"'{NAMES[4]}'" in message for message in named) == 1


@pytest.mark.parametrize("workers", [0, 2])
def test_skip_in_evaluation_leaves_out(dataset: MFNet, workers: int) -> None:
    damage(dataset, NAMES[1], NAMES[3], NAMES[4])
    batches = evaluated(dataset, num_workers=workers, on_error="skip")
    # The second batch would be empty and does not come at all.
    assert [batch.name for batch in batches] == [(NAMES[0], NAMES[2])]
    assert set(batches.skipped) == {NAMES[1], NAMES[3], NAMES[4]}


def test_skip_with_nothing_left(dataset: MFNet) -> None:
    damage(dataset, *NAMES)
    batches = trained(dataset, range(1), on_error="skip")
    said = refused(lambda: next(batches))
    assert "none of the 10 training samples of mfnet can be read" in said


def test_confidences_are_stacked(dataset: MFNet) -> None:
    samples = [dataset.read(name) for name in NAMES[:2]]
    assert collate([crm().test(sample) for sample in samples]).confidence is None
    for value, sample in zip((0.25, 0.75), samples, strict=True):
        object.__setattr__(sample, "confidence", np.full((24, 32), value, np.float32))
    found = collate([crm().test(sample) for sample in samples]).confidence
    assert found.dtype == torch.float32
    assert found.shape == (2, 24, 32)
    assert found.flatten(1).unique(dim=1).tolist() == [[0.25], [0.75]]


def test_pairs_of_one_step_have_its_number(dataset: MFNet) -> None:
    assert [pair.step for pair in paired(dataset, range(6), 3)] == [0, 0, 0, 1, 1, 1]
    (first, *_) = paired(dataset, range(3, 6), 3)
    moved = first.to("cpu")
    assert moved.step == first.step == 1
    assert_equal([moved.source, moved.target], [first.source.to("cpu"), first.target.to("cpu")])


def test_full_shared_memory_is_reported(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(_: torch.Tensor) -> torch.Tensor:
        raise RuntimeError("unable to allocate shared memory(shm): No space left on device (28)")

    monkeypatch.setattr(torch.Tensor, "share_memory_", refuse)  # inherited by the workers
    batches = trained(dataset, range(2), num_workers=2)
    with pytest.raises(InputError, match=r"/dev/shm .*No space left.*--shm-size.*num_workers=0"):
        next(batches)


def test_more_workers_than_cores_are_no_warning(
    dataset: MFNet, monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: {0})
    next(trained(dataset, range(1), num_workers=2))
    assert not [warning for warning in recwarn if "worker" in str(warning.message)]


def test_killed_worker_is_reported(dataset: MFNet, monkeypatch: pytest.MonkeyPatch) -> None:
    main = os.getpid()

    def die(_: str) -> Sample:
        assert os.getpid() != main, "only a worker is to die"
        os.kill(os.getpid(), signal.SIGKILL)
        raise AssertionError("a killed process does nothing more")

    monkeypatch.setattr(dataset, "read", die)
    with pytest.raises(RunError, match=r"loader process died .*memory.*data\.num_workers"):
        next(trained(dataset, range(2), num_workers=1))


@pytest.mark.parametrize(("workers", "ahead", "gpu"), [(0, None, False), (2, 5, True)])
def test_batches_are_prefetched_and_pinned(
    dataset: MFNet, monkeypatch: pytest.MonkeyPatch, workers: int, ahead: int | None, gpu: bool
) -> None:
    """Batches ahead of the one that is used, and pinned where there is a GPU to copy them to."""
    batch = next(trained(dataset, range(1)))
    requested: dict[str, object] = {}
    loader = lambda reader, **words: requested.update(words) or []  # noqa: E731
    monkeypatch.setattr(loaders, "DataLoader", loader)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu)
    assert not list(evaluated(dataset, num_workers=workers, prefetch=5))
    keys = ("num_workers", "prefetch_factor", "pin_memory")
    assert [requested[key] for key in keys] == [workers, ahead, gpu]
    locked: list[torch.Tensor] = []  # pages are locked on machines with a GPU alone
    monkeypatch.setattr(torch.Tensor, "pin_memory", lambda self: locked.append(self) or self)
    LoadedBatch(batch).pin_memory()
    assert len(locked) == sum(isinstance(value, torch.Tensor) for value in vars(batch).values())
    assert LoadedBatch(error="why").pin_memory().error == "why"


# Rare classes.

PIXELS = {"1D": (768, 0, 0), "2D": (668, 100, 0), "3D": (628, 100, 40), "4D": (708, 0, 60)}
"""Pixels of the classes 0 to 2 in images of 24 x 32; 2772, 200 and 100 of 3072 in all."""


@pytest.fixture
def uneven(write_mfnet: Any, png: Callable[[Path, np.ndarray], None]) -> MFNet:
    found = MFNet(str(write_mfnet({"train": list(PIXELS)})))
    for name, counts in PIXELS.items():
        png(found.files(name)[-1], np.repeat(np.arange(3, dtype=np.uint8), counts).reshape(24, 32))
    return found


def rare_settings(**changes: Any) -> LoaderSettings:
    given = {"class_temperature": 0.5, "min_class_pixels": 50, **changes}
    return settings(batch_size=2, sampling="rare_classes", **given)


def counted(dataset: MFNet, **changes: Any) -> RareClasses:
    return count_rare_classes(dataset, "train", rare_settings(**changes))


def test_probability_by_hand() -> None:
    """Shares 0.6, 0.3 and 0.1: exp(4), exp(7) and exp(9) at T = 0.1."""
    weights = np.exp([4.0, 7.0, 9.0])
    found = class_probabilities(np.array([60, 30, 10]), 0.1)
    np.testing.assert_allclose(found, weights / weights.sum())
    assert class_probabilities(np.array([1, 10**9]), 1e-6).tolist() == [1.0, 0.0]


def test_images_are_drawn_with_the_frequencies_of_their_classes(uneven: MFNet) -> None:
    rare = counted(uneven)
    weights = np.exp((1 - np.array([2772, 200, 100]) / 3072) / 0.5)
    p = weights / weights.sum()
    # Image 3 has too few pixels of class 2, which occurs in image 4 alone.
    expected = [p[0] / 4, p[0] / 4 + p[1] / 2, p[0] / 4 + p[1] / 2, p[0] / 4 + p[2]]
    drawn = Counter(
        int(rare.draw(numpy_generator(0, "rare class", 0, number))[1][0]) for number in range(2000)
    )
    for image, share in enumerate(expected):
        assert drawn[image] / 2000 == pytest.approx(share, abs=4 * (share / 2000) ** 0.5)
    assert rare.classes == (0, 1, 2)
    assert rare.shares() == "person 0.473, car 0.444, unlabeled 0.083"


def test_classes_without_a_score_or_an_image(uneven: MFNet) -> None:
    said = refused(lambda: counted(uneven, min_class_pixels=60))
    assert "pixels=60: no image of train of mfnet has more pixels of 'person'" in said
    uneven.unscored = ("unlabeled",)
    rare = counted(uneven, class_temperature=0.1)
    weights = np.exp(np.array([1 / 3, 2 / 3]) / 0.1)
    assert rare.classes == (1, 2)
    np.testing.assert_allclose(rare.probabilities, weights / weights.sum())
    uneven.unscored = uneven.classes
    assert "'any class'" in refused(lambda: counted(uneven))


@pytest.mark.parametrize(
    ("least", "pixels", "ratio", "calls"),
    [
        *[(50, [9, 25, 26, 99], 0.5, 3), (50, [0] * 20, 0.5, 11)],
        *[(50, [0, 99], 0.0, 1), (50, [26], 0.5, 1), (0, [0, 1], 0.5, 2), (0, [0], 0.0, 1)],
    ],
)
def test_crop_is_drawn_again_until_it_shows_enough(
    uneven: MFNet, least: int, pixels: list[int], ratio: float, calls: int
) -> None:
    """Half of 50 pixels, or one pixel, at most ten times again."""
    rare = counted(uneven, min_class_pixels=least, min_crop_ratio=ratio)
    left: Iterator[int] = iter(pixels)
    seen = []

    def make(sample: Any, rng: np.random.Generator) -> Any:
        seen.append(rng.random())
        return SimpleNamespace(label=np.repeat(sample, next(left)))

    drawn, _ = rare.draw(numpy_generator(3, "rare class", 0, 5))
    dataset: Any = SimpleNamespace(read=lambda name: drawn)
    transform: Any = SimpleNamespace(train=make)
    Examples(dataset, tuple(PIXELS), transform, False, 3, rare).train((0, 5), {})
    assert len(set(seen)) == len(seen) == calls
    # The draws of the augmentation are those of (seed, "augment", epoch, number) alone, and not
    # those that have chosen the class.
    assert seen == numpy_generator(3, "augment", 0, 5).random(calls).tolist()


def drawn(dataset: MFNet, steps: range, seed: int = 7, **changes: Any) -> list[Batch]:
    given, rare = rare_settings(**changes), counted(dataset, **changes)
    found: Any = train_batches(dataset, "train", crm(), given, seed, steps, rare)
    return list(found)


def test_same_draws_whatever_the_workers_and_the_first_step(uneven: MFNet) -> None:
    """Two steps per epoch; a run that resumes at step 3 has the batches of one that did not."""
    whole = drawn(uneven, range(6))
    for workers in (0, 2):
        assert_equal(drawn(uneven, range(3, 6), num_workers=workers), whole[3:])
    names = [batch.name for batch in whole]
    assert len(set(names)) > 1
    assert names != [batch.name for batch in drawn(uneven, range(6), seed=8)]


def test_unreadable_images_are_not_drawn(uneven: MFNet) -> None:
    """Image 4 alone has class 2: without its label, images 2 and 3 are drawn."""
    for path in (*uneven.files("2D"), *uneven.files("4D")):
        path.write_bytes(b"damaged")
    few = {"min_class_pixels": 30, "class_temperature": 0.01}
    found = drawn(uneven, range(6), on_error="skip", **few)
    assert {name for batch in found for name in batch.name} == {"3D"}
    assert "cannot be" in refused(lambda: counted(uneven))
