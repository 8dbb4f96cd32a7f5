"""Read, transform and stack the samples of one batch in a loader process.

`rgbt.data.loaders` chooses the samples of each batch.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, fields, replace
from typing import Any

import cv2
import numpy as np
from torch import Tensor
from torch.utils.data import Dataset, get_worker_info

from rgbt.checks import InputError
from rgbt.data.batches import Transform
from rgbt.dataset import LabelledDataset
from rgbt.randomness import numpy_generator
from rgbt.types import Example, Loadable, Sample

MakeExample = Callable[[Any, dict[str, str]], Any]
"""(key, skipped) -> example, or None if it is left out; adds unreadable names to `skipped`."""

Stack = Callable[[list[Any]], Loadable]
"""Examples of one size -> one batch; InputError if their sizes differ."""

ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Signals that end a command (`rgbt.runtime.signals`)."""

LOOK_S = 2.0
"""Interval at which a worker checks that its main process exists."""


@dataclass(frozen=True)
class SplitReader:
    """Reads the samples of one split.

    Attributes:
        dataset: reads samples.
        names: the split.
        transform: makes examples.
        skip_errors: record an unreadable sample instead of raising.
    """

    dataset: LabelledDataset
    names: tuple[str, ...]
    transform: Transform
    skip_errors: bool

    def read(self, name: str, skipped: dict[str, str]) -> Sample | None:
        """The sample; None, with the reason in `skipped`, if it is skipped."""
        try:
            return self.dataset.read(name)
        except InputError as error:
            if not self.skip_errors:
                raise
            skipped[name] = str(error)
            return None

    def first_readable(self, names: Sequence[str], skipped: dict[str, str]) -> Sample:
        """The first of these samples that can be read.

        Raises:
            InputError: there is none.
        """
        for name in names:
            sample = self.read(name, skipped)
            if sample is not None:
                return sample
        raise InputError(
            f"none of the {len(names)} training samples of {self.dataset.name} can be read; the "
            f"first one: {skipped[names[0]]}"
        )


@dataclass(frozen=True)
class TrainExamples:
    """Augmented examples; a key is (epoch, index in the split).

    Attributes:
        source: reads samples.
        make: (sample, generator) -> example: the transform's `train`.
        seed: run seed.
    """

    source: SplitReader
    make: Callable[[Sample, np.random.Generator], Any]
    seed: int

    def __call__(self, key: tuple[int, int], skipped: dict[str, str]) -> Any:
        """The example of `key`, or of the next readable sample of the list.

        Raises:
            InputError: no sample of the split can be read.
        """
        epoch, index = key
        names = self.source.names
        sample = self.source.first_readable((*names[index:], *names[:index]), skipped)
        return self.make(sample, numpy_generator(self.seed, "augment", epoch, index))


@dataclass(frozen=True)
class EvalExamples:
    """Examples for evaluation; a key is a name."""

    source: SplitReader

    def __call__(self, key: str, skipped: dict[str, str]) -> Example | None:
        """The example of `key`, or None if it cannot be read."""
        sample = self.source.read(key, skipped)
        return None if sample is None else self.source.transform.test(sample)


@dataclass(frozen=True)
class LoadedBatch:
    """The result of a worker.

    Attributes:
        batch: a dataclass of tensors; None if every sample was left out, or after an error.
        skipped: name -> error.
        error: message of an InputError; a text, because torch wraps exceptions of workers.
    """

    batch: Loadable | None = None
    skipped: dict[str, str] = field(default_factory=dict)
    error: str = ""

    def pin_memory(self) -> LoadedBatch:
        """The batch in pinned memory; called by a thread of the loader."""
        return self if self.batch is None else replace(self, batch=_each(self.batch, _pinned))


class BatchReader(Dataset[LoadedBatch]):
    """Makes the batch of a list of keys.

    Args:
        make_example: called once per key.
        stack: makes a batch of examples.
    """

    def __init__(self, make_example: MakeExample, stack: Stack):
        self.make_example = make_example
        self.stack = stack

    def __getitem__(self, keys: list[Any]) -> LoadedBatch:
        """The batch of `keys`, without the samples that are left out."""
        skipped: dict[str, str] = {}
        try:
            found = [self.make_example(key, skipped) for key in keys]
            examples = [example for example in found if example is not None]
            batch = self.stack(examples) if examples else None
            if batch is not None and get_worker_info() is not None:
                batch = _each(batch, _shared)
        except InputError as error:
            return LoadedBatch(skipped=skipped, error=str(error))
        return LoadedBatch(batch, skipped)


@contextmanager
def signals_blocked() -> Iterator[None]:
    """Within it, processes that are started have the signals of `ENDING` blocked in all threads.

    Some libraries, such as Arrow, start threads of their own in a process as soon as it is forked,
    before `start_worker` is called.
    """
    before = signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def start_worker(_: int) -> None:
    """Settings of a worker process; it is started within `signals_blocked`."""
    # There is one process per core; threads of OpenCV would compete with them.
    cv2.setNumThreads(0)
    # A terminal and a cluster signal all processes of a run. The main process needs its workers
    # to finish its step, and then ends them. A fork server starts workers without our mask.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Exit when the main process sends SIGTERM, or has ended."""
    # Not os.getppid: in a sweep a server forks the workers, and lives longer than the main process.
    parent = multiprocessing.parent_process()
    assert parent is not None, "a worker has a main process"
    while parent.is_alive():
        received = signal.sigtimedwait(ENDING, LOOK_S)
        if received and received.si_signo == signal.SIGTERM and received.si_pid == parent.pid:
            break
    os._exit(0)


def _each(batch: Any, change: Callable[[Tensor], Tensor]) -> Any:
    """`batch`, a dataclass, with `change` applied to each of its tensors."""
    values = {each.name: getattr(batch, each.name) for each in fields(batch)}
    tensors = {name: value for name, value in values.items() if isinstance(value, Tensor)}
    return replace(batch, **{name: change(value) for name, value in tensors.items()})


def _pinned(tensor: Tensor) -> Tensor:
    return tensor.pin_memory()


def _shared(tensor: Tensor) -> Tensor:
    """`tensor` in memory that the main process can read.

    The worker's queue would do so too, but in a thread whose errors are not reported: the main
    process would wait forever.
    """
    try:
        tensor.share_memory_()  # type: ignore[no-untyped-call]
    except RuntimeError as error:
        raise InputError(no_shared_memory(str(error).splitlines()[0])) from None
    return tensor


def no_shared_memory(reason: str) -> str:
    """The message about missing shared memory; `reason` is what the system reported."""
    return (
        f"The loader processes cannot get shared memory in /dev/shm ({reason}). Enlarge it "
        "(docker run --shm-size=8g, or mount -o remount,size=8g /dev/shm), or load in the main "
        "process with data.num_workers=0."
    )
