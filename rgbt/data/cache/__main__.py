"""Command that fills the cache of decoded images, or removes it.

python -m rgbt.data.cache dataset=mfnet dataset.root=... cache=auto    # decode, show the size
python -m rgbt.data.cache dataset=mfnet dataset.root=... remove=true   # and remove it
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
from rgbt.data.cache.dataset import Decoded, check_cache, decoded_dataset
from rgbt.data.cache.store import Told, gigabytes, remove, size_of
from rgbt.data.dataset import LabelledDataset


@contextmanager
def shown() -> Iterator[Told]:
    """Progress bars on stderr for `Decoded.ensure`, one for each thing that is done."""
    with Progress(console=Console(stderr=True)) as progress:
        tasks: dict[str, TaskID] = {}

        def advance(what: str, done: int, total: int) -> None:
            if what not in tasks:
                tasks[what] = progress.add_task(what)
            progress.update(tasks[what], completed=done, total=total)

        yield advance


@dataclass(frozen=True)
class Options:
    """Of the cache."""

    cache: Annotated[str, Help("auto, or the folder where caches lie")] = "auto"
    remove: Annotated[
        bool, Help("true: remove the cache, and those of earlier states of the same folder")
    ] = False


def main(options: Options, overrides: list[str]) -> int:
    """Decode every split of a data set into a cache and show its size, or remove it.

    Overrides choose the data set: dataset=mfnet dataset.root=/data/MFNet
    """
    check_cache("cache", options.cache)
    source: LabelledDataset = built("dataset", overrides)
    dataset = decoded_dataset(source, options.cache, num_threads=os.cpu_count() or 1)
    assert isinstance(dataset, Decoded)
    if not options.remove:
        splits = [split for split in source.splits if source.has(split)]
        with shown() as advance:
            dataset.ensure(tuple(name for split in splits for name in source.names(split)), advance)
    for cache in dataset.caches():
        sys.stdout.write(f"{cache}: {gigabytes(size_of(cache))}{' removed' * options.remove}\n")
        if options.remove:
            remove(cache)
    return 0


entry = PlainCommand(Options, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
