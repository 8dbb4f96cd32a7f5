"""Load batches for training and evaluation.

The samples of a batch and their augmentation depend on (seed, step) alone, not on the number of
worker processes. Batches are not padded: networks pad images and losses pad labels.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import re
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any, Protocol, cast

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, get_worker_info

from rgbt.checks import InputError, RunError, of_posix, without_controls
from rgbt.data.loader_settings import LoaderSettings as LoaderSettings  # as conf/ names it
from rgbt.data.rare_classes import RareClasses, crop_showing
from rgbt.dataset import LabelledDataset
from rgbt.processes import num_processes, rank
from rgbt.randomness import numpy_generator
from rgbt.types import Batch, Example, Sample, TwoDomains

LOG = logging.getLogger(__name__)

CROP_ADVICE = "; choose a transform.crop_hw that fits into every resized image"
EVAL_ADVICE = "; set data.eval_batch_size=1"
DEAD_WORKER = re.compile(r"DataLoader worker .*(exited unexpectedly|killed by signal)")

# Signals that end a command (`rgbt.runtime.signals`).
ENDING = {signal.SIGINT, signal.SIGTERM, getattr(signal, "SIGHUP", signal.SIGTERM)}

# Interval at which a worker checks that its main process exists.
LOOK_S = 2.0

# (key, skipped) -> example, or None if it is left out; adds unreadable names to `skipped`.
MakeExample = Callable[[Any, dict[str, str]], Any]


class Transform(Protocol):
    """Makes examples of samples (see `rgbt.transforms.crm.CrmTransform`)."""

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example; every draw comes from `rng`."""

    def test(self, sample: Sample) -> Example:
        """Make an example for evaluation, the same every time."""


@dataclass(frozen=True)
class Examples:
    """Reads and transforms the samples `names` of one split.

    Attributes:
        skip_errors: unreadable samples are recorded instead of raised.
        seed: of the run.
        rare: how training samples are drawn by class; None: those of their position in the split.
    """

    dataset: LabelledDataset
    names: tuple[str, ...]
    transform: Transform
    skip_errors: bool
    seed: int = 0
    rare: RareClasses | None = None

    def read(self, name: str, skipped: dict[str, str]) -> Sample | None:
        """Read the sample; None, with the reason in `skipped`, if it is skipped."""
        try:
            return self.dataset.read(name)
        except InputError as error:
            if not self.skip_errors:
                raise
            skipped[name] = str(error)
            return None

    def first_readable(self, names: Sequence[str], skipped: dict[str, str]) -> Sample:
        """Read the first of these samples that can be read; InputError if there is none."""
        for name in names:
            sample = self.read(name, skipped)
            if sample is not None:
                return sample
        raise InputError(
            f"none of the {len(names)} training samples of {self.dataset.name} can be read; the "
            f"first one: {skipped[names[0]]}"
        )

    def train(self, key: tuple[int, int], skipped: dict[str, str]) -> Example:
        """Augment the sample of (epoch, index in the split), or the next readable one.

        With `rare`, the index is the number of a sample in its epoch: the example is of the image
        drawn for it, or of the next readable one of the same class.
        """
        epoch, index = key
        rng = numpy_generator(self.seed, "augment", epoch, index)
        if self.rare is None:
            names = (*self.names[index:], *self.names[:index])
            return self.transform.train(self.first_readable(names, skipped), rng)
        draws = numpy_generator(self.seed, "rare class", epoch, index)
        drawn, positions = self.rare.draw(draws)
        sample = self.first_readable([self.names[position] for position in positions], skipped)
        return crop_showing(
            drawn, self.rare.min_crop_pixels, lambda: self.transform.train(sample, rng)
        )

    def test(self, key: str, skipped: dict[str, str]) -> Example | None:
        """Make the example of a name for evaluation, or None if it cannot be read."""
        sample = self.read(key, skipped)
        return None if sample is None else self.transform.test(sample)


def collate(examples: Sequence[Example], advice: str = "") -> Batch:
    """Stack examples of one size (see `rgbt.types.Batch` for shapes and dtypes).

    InputError: images or labels differ in size, naming the first two that do, and `advice`, the key
    to change.
    """
    first = examples[0]
    for example in examples[1:]:
        for what in ("rgb", "label"):
            expected, found = getattr(first, what).shape[:2], getattr(example, what).shape[:2]
            if found != expected:
                raise InputError(
                    f"all {what} images of one batch must have one size, got "
                    f"{expected[0]}x{expected[1]} ('{first.name}') and {found[0]}x{found[1]} "
                    f"('{example.name}'){advice}."
                )

    def stacked(images: Iterable[NDArray[Any] | None]) -> Tensor | None:
        present = [image for image in images if image is not None]
        return torch.from_numpy(np.stack(present)) if present else None

    rgb_BHWC = torch.from_numpy(np.stack([example.rgb for example in examples]))
    thermal_BHW = torch.from_numpy(np.stack([example.thermal for example in examples]))
    return Batch(
        rgb=rgb_BHWC.permute(0, 3, 1, 2).contiguous(),
        thermal=thermal_BHW[:, None],
        label=torch.from_numpy(np.stack([example.label for example in examples])),
        name=tuple(example.name for example in examples),
        centre_yx=torch.tensor([example.centre_yx for example in examples]),
        position=stacked(example.position for example in examples),
        original_hw=torch.tensor([example.original_hw for example in examples]),
        confidence=stacked(example.confidence for example in examples),
    )


@dataclass(frozen=True)
class LoadedBatch:
    """Carries the result of a worker: a batch, or None without samples or after an error.

    `skipped`: name -> error. `error`: message of an InputError, because torch wraps exceptions.
    """

    batch: Batch | None = None
    skipped: dict[str, str] = field(default_factory=dict)
    error: str = ""

    def pin_memory(self) -> LoadedBatch:
        """Move the batch to pinned memory; called by a thread of the loader."""
        if self.batch is None:
            return self
        return replace(self, batch=_changed(self.batch, torch.Tensor.pin_memory))


@dataclass
class BatchReader(Dataset[LoadedBatch]):
    """Makes the batch of a list of keys, one example of each; `advice`: see `collate`."""

    make_example: MakeExample
    advice: str

    def __getitem__(self, keys: list[Any]) -> LoadedBatch:
        """Make the batch of `keys`, without the samples that are left out."""
        skipped: dict[str, str] = {}
        try:
            found = [self.make_example(key, skipped) for key in keys]
            examples = [example for example in found if example is not None]
            batch = collate(examples, self.advice) if examples else None
            if batch is not None and get_worker_info() is not None:
                batch = _changed(batch, _shared)
        except InputError as error:
            return LoadedBatch(skipped=skipped, error=str(error))
        return LoadedBatch(batch, skipped)


@contextmanager
def _blocked(num_workers: int) -> Iterator[None]:
    """Block signals in all threads of the new workers: some libraries start some when forked."""
    if not num_workers:
        yield
        return
    change = of_posix("signal.pthread_sigmask", f"data.num_workers={num_workers}")
    before = change(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        change(signal.SIG_SETMASK, before)


class Batches(Iterator[Batch]):
    """Loads batches in order, one by `reader` for every list of `keys`.

    Attributes:
        skipped: name -> error, of the samples skipped so far.
    """

    def __init__(
        self, reader: BatchReader, *, keys: Iterable[list[Any]], settings: LoaderSettings
    ) -> None:
        self.skipped: dict[str, str] = {}
        with _blocked(settings.num_workers), warnings.catch_warnings():
            # More workers than cores wait for each other; nothing else is wrong with them.
            warnings.filterwarnings("ignore", "This DataLoader will create")
            loader = DataLoader(
                reader,
                sampler=keys,
                batch_size=None,  # a key is a whole batch
                num_workers=settings.num_workers,
                prefetch_factor=settings.prefetch if settings.num_workers else None,
                worker_init_fn=start_worker,
                pin_memory=torch.cuda.is_available(),
                # Without it the loader draws the seed of its workers from the global generator.
                generator=torch.Generator(),
            )
            self._loaded = cast(Iterator[LoadedBatch], iter(loader))

    def __next__(self) -> Batch:
        """Return the next batch that holds at least one sample.

        InputError: a file cannot be read (on_error="raise"), sizes differ within the batch, or
        there is no shared memory left. RunError: a worker process died.
        """
        while True:
            try:
                loaded = next(self._loaded)
            except RuntimeError as error:
                if not DEAD_WORKER.search(str(error)):
                    raise
                raise RunError(
                    f"A loader process died ({str(error).splitlines()[0].rstrip('. ')}), probably "
                    "because memory ran out. Lower data.num_workers, data.prefetch or "
                    "data.batch_size, and rerun the command to resume."
                ) from error
            for name, reason in loaded.skipped.items():
                if name not in self.skipped:
                    LOG.warning("%s", without_controls(f"skipped '{name}': {reason}"))
            self.skipped.update(loaded.skipped)
            if loaded.error:
                self.close()
                raise InputError(loaded.error)
            if loaded.batch is not None:
                return loaded.batch

    def close(self) -> None:
        """Stop the worker processes; no batch can be read afterwards."""
        # Workers end when the loader's iterator is deleted, and a traceback may keep it alive.
        self._loaded = iter(())


def train_batches(  # noqa: PLR0913 - most trainings draw no classes
    dataset: LabelledDataset,
    split: str,
    transform: Transform,
    settings: LoaderSettings,
    seed: int,
    steps: range,
    rare: RareClasses | None = None,
) -> Batches:
    """Load augmented training batches of the global steps in `steps`, by ``transform.train``.

    Epoch e is a permutation of the split drawn from (seed, "order", e), cut into whole batches; the
    incomplete last one is dropped. Sample i of epoch e is augmented from (seed, "augment", e, i).
    So ``steps=range(10, 20)`` continues ``range(10)`` exactly. With `rare`, sample i of epoch e is
    drawn by its class from (seed, "rare class", e, i) instead. Process r of W has the samples r,
    r + W, r + 2 W, ... of each batch (`rgbt.processes`).

    InputError: as `steps_per_epoch`; with on_error="skip", the split is unreadable.
    """
    steps_per_epoch(dataset, settings, split)
    names = dataset.names(split)
    source = Examples(dataset, names, transform, settings.on_error == "skip", seed, rare)
    keys = _train_keys(len(names), settings.batch_size, steps, seed, is_shuffled=rare is None)
    own_samples = slice(rank(), None, num_processes())
    own_keys = (whole_batch[own_samples] for whole_batch in keys)
    return Batches(BatchReader(source.train, CROP_ADVICE), keys=own_keys, settings=settings)


def eval_batches(
    dataset: LabelledDataset,
    names: tuple[str, ...],
    transform: Transform,
    settings: LoaderSettings,
) -> Batches:
    """Load the samples called `names` once, in this order, by ``transform.test``.

    Process r of W has the batches r, r + W, r + 2 W, ..., possibly none.
    """
    source = Examples(dataset, names, transform, settings.on_error == "skip")
    size = settings.eval_batch_size
    keys = [list(names[start : start + size]) for start in range(0, len(names), size)]
    reader = BatchReader(source.test, EVAL_ADVICE)
    return Batches(reader, keys=keys[rank() :: num_processes()], settings=settings)


def steps_per_epoch(
    dataset: LabelledDataset, settings: LoaderSettings, split: str = "train"
) -> int:
    """Return the number of whole batches of one epoch, at least 1.

    InputError: the split is smaller than a batch; the processes cannot share one equally.
    """
    check_batch_size(settings, num_processes())
    size = len(dataset.names(split))
    if size < settings.batch_size:
        raise InputError(
            f"data.batch_size is {settings.batch_size} but split '{split}' of {dataset.name} has "
            f"only {size} names; lower data.batch_size."
        )
    return size // settings.batch_size


def check_batch_size(settings: LoaderSettings, processes: int) -> None:
    """Refuse a training batch that this number of processes cannot share equally (InputError)."""
    if settings.batch_size % processes:
        raise InputError(
            f"data.batch_size is {settings.batch_size}, which {processes} devices cannot share "
            f"equally; set a multiple of {processes}, or another trainer.devices."
        )


def _train_keys(
    size: int, batch_size: int, steps: range, seed: int, *, is_shuffled: bool
) -> Iterator[list[tuple[int, int]]]:
    """Yield (epoch, index in the split) of every sample, step by step."""
    drawn, order = -1, list(range(size))
    for step in steps:
        epoch, position = divmod(step, size // batch_size)
        if is_shuffled and epoch != drawn:
            order = numpy_generator(seed, "order", epoch).permutation(size).tolist()
            drawn = epoch
        start = position * batch_size
        yield [(epoch, index) for index in order[start : start + batch_size]]


def start_worker(_: int) -> None:
    """Set up a worker process."""
    # There is one process per core; threads of OpenCV would compete with them.
    cv2.setNumThreads(0)
    # A terminal and a cluster signal all processes of a run. The main process needs its workers
    # to finish its step, and then ends them. A fork server starts workers without our mask.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the main process sends SIGTERM, or has ended."""
    # In a sweep, os.getppid is a server that forks the workers and outlives the main process.
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a main process"
    if not hasattr(signal, "sigtimedwait"):  # macOS
        parent.join()
        os._exit(0)
    while parent.is_alive():
        received = signal.sigtimedwait(ENDING, LOOK_S)
        if received and received.si_signo == signal.SIGTERM and received.si_pid == parent.pid:
            break
    os._exit(0)


def _changed(batch: Batch, change: Callable[[Tensor], Tensor]) -> Batch:
    """Apply `change` to every tensor of `batch`."""
    changed: dict[str, Any] = {}
    for name, value in vars(batch).items():
        if isinstance(value, Tensor):
            changed[name] = change(value)
    return replace(batch, **changed)


def _shared(tensor: Tensor) -> Tensor:
    """Move `tensor` to memory that the main process can read.

    The worker's queue would do so too, but in a thread whose errors are not reported: the main
    process would wait forever.
    """
    try:
        tensor.share_memory_()  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise InputError(
            f"The loader processes cannot get shared memory in /dev/shm ({error}). Enlarge it "
            "(docker run --shm-size=8g), or load in the main process with data.num_workers=0."
        ) from None
    return tensor


class PairedBatches(Iterator[TwoDomains]):
    """Pairs a batch of the source with one of the target, each from its own stream.

    The two lists may differ in length. Each is shuffled again at its end, and an epoch of the run
    is one of the source.

    `first` is the number of the first pair, counted from the start of the run; `per_step` pairs
    belong to one optimiser step and have its number.
    """

    def __init__(self, source: Batches, target: Batches, *, first: int, per_step: int) -> None:
        self._source, self._target = source, target
        self._numbers = count(first)
        self._per_step = per_step

    def __next__(self) -> TwoDomains:
        """Return the next pair; errors as of `Batches`."""
        try:
            source, target = next(self._source), next(self._target)
        except BaseException:
            self.close()
            raise
        return TwoDomains(source, target, next(self._numbers) // self._per_step)

    @property
    def skipped(self) -> dict[str, str]:
        """Errors of the samples skipped so far, by name."""
        return self._source.skipped | self._target.skipped

    def close(self) -> None:
        """Stop the worker processes of both."""
        self._source.close()
        self._target.close()
