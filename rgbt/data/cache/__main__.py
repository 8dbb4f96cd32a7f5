"""Command that fills the image cache, or removes it.

python -m rgbt.data.cache dataset=mfnet dataset.root=... cache=auto    # fill it, show the size
python -m rgbt.data.cache dataset=mfnet dataset.root=... remove=true   # and remove it
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import Progress, TaskID

from rgbt.checks import InputError, check_choice
from rgbt.config.command import built, plain_command
from rgbt.data.cache.dataset import CachedDataset, cached_dataset, check_cache
from rgbt.data.cache.folder import OnProgress, gigabytes, remove, size_of
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


OWN = {"cache": "auto", "remove": "false"}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Decode every split of a data set into the image cache and show its size, or remove it.

    cache      auto, or the folder that holds caches
    remove     true: remove the cache, and those of former states of the same data set
    overrides  such as dataset=mfnet dataset.root=/data/MFNet
    """
    check_choice("remove", arguments["remove"], ("true", "false"))
    check_cache("cache", arguments["cache"])
    for word in overrides:
        key = word.lstrip("+").partition("=")[0]
        if key.partition(".")[0] != "dataset" and key != "hydra.searchpath":
            raise InputError(
                f"'{key}' has no effect here; give dataset=... and its settings, cache=FOLDER for "
                "the folder of caches, or remove=true."
            )
    source: LabelledDataset = built("dataset", overrides)
    dataset = cached_dataset(source, arguments["cache"], num_threads=os.cpu_count() or 1)
    assert isinstance(dataset, CachedDataset)
    removes = arguments["remove"] == "true"
    if not removes:
        splits = [split for split in source.splits if source.has(split)]
        names = tuple(name for split in splits for name in source.names(split))
        with progress_bars() as on_progress:
            dataset.ensure(names, on_progress)
    for cache in dataset.caches():
        sys.stdout.write(f"{cache}: {gigabytes(size_of(cache))}{' removed' * removes}\n")
        if removes:
            remove(cache)
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
