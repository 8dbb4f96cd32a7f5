"""The command ``rgbt cache``, which fills or removes the image cache.

rgbt cache dataset=mfnet dataset.root=... cache=auto    # fill it, show the size
rgbt cache dataset=mfnet dataset.root=... remove=true   # and remove it
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Annotated

from rich.console import Console
from rich.progress import Progress, TaskID

from rgbt.config.command import built
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand
from rgbt.data.cache.dataset import (
    CachedDataset,
    cached_dataset,
    check_cache,
    gigabytes,
    remove,
    size_of,
)
from rgbt.data.cache.sample_map import OnProgress
from rgbt.dataset import LabelledDataset


@contextmanager
def progress_bars() -> Iterator[OnProgress]:
    """Progress bars on stderr for `CachedDataset.ensure`, one per kind of work."""
    with Progress(console=Console(stderr=True)) as progress:
        tasks: dict[str, TaskID] = {}

        def advance(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what)
            progress.update(tasks[what], completed=done, total=total)

        yield advance


@dataclass(frozen=True)
class Options:
    """Options of the command."""

    cache: Annotated[str, Help("auto, or the folder for caches")] = "auto"
    remove: Annotated[
        bool, Help("true: remove the cache of the data set and those of its former states")
    ] = False


def main(options: Options, overrides: list[str]) -> int:
    """Write every split of a data set to the image cache and print its size, or remove it.

    Overrides choose the data set: dataset=mfnet dataset.root=/data/MFNet
    """
    check_cache("cache", options.cache)
    source: LabelledDataset = built("dataset", overrides)
    dataset = cached_dataset(source, options.cache, num_threads=os.cpu_count() or 1)
    assert isinstance(dataset, CachedDataset)
    if not options.remove:
        splits = [split for split in source.splits if source.has(split)]
        names = tuple(name for split in splits for name in source.names(split))
        with progress_bars() as on_progress:
            dataset.ensure(names, on_progress)
    for cache in dataset.caches():
        sys.stdout.write(f"{cache}: {gigabytes(size_of(cache))}{' removed' * options.remove}\n")
        if options.remove:
            remove(cache)
    return 0


entry = PlainCommand(Options, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
