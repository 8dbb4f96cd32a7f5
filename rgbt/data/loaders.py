"""Load batches for training and evaluation.

The samples of a batch and their augmentation depend on (seed, step) alone, not on the number of
worker processes. Where several processes train one run, each loads every W-th sample of a batch
(`rgbt.processes`). Batches are not padded: networks pad images and losses pad labels.
"""

from __future__ import annotations

import errno
import logging
import multiprocessing
import re
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy as np
import torch
from torch.utils.data import DataLoader

from rgbt.checks import InputError, RunError
from rgbt.data.batches import Transform, collate
from rgbt.data.loader_settings import LoaderSettings as LoaderSettings  # as conf/ names it
from rgbt.data.reader import (
    BatchReader,
    EvalExamples,
    LoadedBatch,
    MakeExample,
    SplitReader,
    TrainExamples,
    no_shared_memory,
    signals_blocked,
    start_worker,
)
from rgbt.dataset import LabelledDataset
from rgbt.processes import num_processes, rank
from rgbt.randomness import numpy_generator
from rgbt.types import Batch, Loadable

if TYPE_CHECKING:
    from rgbt.data.rare_classes import RareClasses

LOG = logging.getLogger(__name__)

CROP_ADVICE = (
    "; choose a transform.crop_hw that fits into every resized image, or the sizes for this data "
    "set (recipe=kp, ...)"
)
EVAL_ADVICE = "; set data.eval_batch_size=1"

DEAD_WORKER = re.compile(r"DataLoader worker .*(exited unexpectedly|killed by signal)")

LOCKS_PER_WORKER = 16

Kind = TypeVar("Kind", bound=Loadable)


class Batches(Iterator[Kind]):
    """Batches in order, as `train_batches` and `eval_batches` make them.

    Args:
        reader: makes a batch of a list of keys.
        keys: one list of keys per batch.
        settings: processes that read, and how far ahead.

    Attributes:
        skipped: name -> error, of the samples skipped so far.
    """

    def __init__(
        self, reader: BatchReader, *, keys: Iterable[list[Any]], settings: LoaderSettings
    ) -> None:
        self.skipped: dict[str, str] = {}
        loader = DataLoader(
            reader,
            sampler=keys,
            batch_size=None,  # a key is a whole batch
            collate_fn=_unchanged,
            num_workers=settings.num_workers,
            prefetch_factor=settings.prefetch if settings.num_workers else None,
            worker_init_fn=start_worker,
            pin_memory=torch.cuda.is_available(),
            # Without it the loader draws the seed of its workers from the global generator.
            generator=torch.Generator(),
        )
        self._loaded = cast(Iterator[LoadedBatch], _started(loader, settings.num_workers))

    def __next__(self) -> Kind:
        """The next batch that holds at least one sample.

        Raises:
            InputError: a file cannot be read (on_error="raise"), sizes differ within the batch, or
                there is no shared memory left.
            RunError: a worker process died.
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
                    LOG.warning("skipped '%s': %s", name, reason)
            self.skipped.update(loaded.skipped)
            if loaded.error:
                self.close()
                raise InputError(loaded.error)
            if loaded.batch is not None:
                return cast(Kind, loaded.batch)

    def close(self) -> None:
        """Stop the worker processes; no batch can be read afterwards."""
        # Workers end when the loader's iterator is deleted, and a traceback may keep it alive.
        self._loaded = iter(())


def _started(loader: DataLoader[Any], num_workers: int) -> Iterator[Any]:
    """The loader's iterator, which starts its worker processes.

    Raises:
        InputError: the system has no shared memory or locks left.
    """
    try:
        # A loader that fails while it starts prints its own traceback. These locks, a few more than
        # it needs, fail earlier.
        _ = [multiprocessing.Lock() for _ in range(LOCKS_PER_WORKER * num_workers)]
        with signals_blocked():
            return iter(loader)
    except OSError as error:
        if error.errno != errno.ENOSPC:
            raise
        raise InputError(no_shared_memory(str(error.strerror))) from None  # not a disk


def train_batches(  # noqa: PLR0913 - most trainings draw no classes
    dataset: LabelledDataset,
    split: str,
    transform: Transform,
    settings: LoaderSettings,
    seed: int,
    steps: range,
    rare: RareClasses | None = None,
) -> Batches[Loadable]:
    """Augmented training batches of the global steps in `steps`, made by ``transform.train``.

    Process r of W has the samples r, r + W, r + 2 W, ... of each batch.

    Epoch e is a permutation of the split drawn from (seed, "order", e), cut into whole batches; the
    incomplete last one is dropped. Sample i of epoch e is augmented from (seed, "augment", e, i).
    So ``steps=range(10, 20)`` continues ``range(10)`` exactly.

    With `rare`, sample i of epoch e is drawn by its class from (seed, "rare class", e, i) instead.

    Raises:
        InputError: the split is smaller than a batch, or, with on_error="skip", unreadable; the
            processes cannot share a batch equally.
    """
    per_epoch = steps_per_epoch(dataset, settings, split)
    names = dataset.names(split)
    source = SplitReader(dataset, names, transform, settings.on_error == "skip")
    make: MakeExample = TrainExamples(source, transform.train, seed)
    if rare is not None:
        from rgbt.data.rare_classes import RareClassExamples  # few runs draw by class

        make = RareClassExamples(source, transform.train, seed, rare)
    order = partial(numpy_generator, seed, "order")
    whole_batches = _train_keys(
        len(names), settings.batch_size, per_epoch, steps, None if rare else order
    )
    own_samples = slice(rank(), None, num_processes())
    keys = (keys[own_samples] for keys in whole_batches)
    reader = BatchReader(make, partial(collate, advice=CROP_ADVICE))
    return Batches(reader, keys=keys, settings=settings)


def eval_batches(
    dataset: LabelledDataset, split: str, transform: Transform, settings: LoaderSettings
) -> Batches[Batch]:
    """Every sample of the split once, in the order of its list, made by ``transform.test``.

    Process r of W has the batches r, r + W, r + 2 W, ..., possibly none.
    """
    names = dataset.names(split)
    source = SplitReader(dataset, names, transform, settings.on_error == "skip")
    size = settings.eval_batch_size
    keys = [list(names[start : start + size]) for start in range(0, len(names), size)]
    return Batches(
        BatchReader(EvalExamples(source), partial(collate, advice=EVAL_ADVICE)),
        keys=keys[rank() :: num_processes()],
        settings=settings,
    )


def steps_per_epoch(
    dataset: LabelledDataset, settings: LoaderSettings, split: str = "train"
) -> int:
    """Whole batches of one epoch, at least 1.

    Raises:
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
    """Refuse a training batch that this number of processes cannot share equally.

    Raises:
        InputError: the number does not divide the samples of a batch.
    """
    if settings.batch_size % processes:
        raise InputError(
            f"data.batch_size is {settings.batch_size}, which {processes} devices cannot share "
            f"equally. Set data.batch_size to a multiple of {processes}, or trainer.devices to a "
            f"divisor of {settings.batch_size}."
        )


def _train_keys(
    size: int,
    batch_size: int,
    per_epoch: int,
    steps: range,
    rng_of: Callable[[int], np.random.Generator] | None,
) -> Iterator[list[tuple[int, int]]]:
    """(epoch, index in the split) of every sample of every step; numbers without `rng_of`."""
    drawn = -1
    order = list(range(size))
    for step in steps:
        epoch, position = divmod(step, per_epoch)
        if rng_of is not None and epoch != drawn:
            order = rng_of(epoch).permutation(size).tolist()
            drawn = epoch
        start = position * batch_size
        yield [(epoch, index) for index in order[start : start + batch_size]]


def _unchanged(loaded: Any) -> Any:
    return loaded
