"""Command that fills the cache of decoded images, or removes it.

python -m rgbt.data.cache dataset=mfnet dataset.root=... cache=auto    # decode, show the size
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


OWN = {"cache": "auto", "remove": "false"}


def main(arguments: dict[str, str], overrides: list[str]) -> int:
    """Decode every split of a data set into a cache and show its size, or remove it.

    cache      auto, or the folder where caches lie
    remove     true: remove the cache, and those of earlier states of the same folder
    overrides  such as dataset=mfnet dataset.root=/data/MFNet
    """
    check_choice("remove", arguments["remove"], ("true", "false"))
    check_cache("cache", arguments["cache"])
    for word in overrides:
        key = word.lstrip("+").partition("=")[0]
        if key.partition(".")[0] != "dataset" and key != "hydra.searchpath":
            raise InputError(
                f"'{key}' has no effect here; give dataset=... and its settings, cache=FOLDER for "
                "where the cache lies, or remove=true."
            )
    source: LabelledDataset = built("dataset", overrides)
    dataset = decoded_dataset(source, arguments["cache"], num_threads=os.cpu_count() or 1)
    assert isinstance(dataset, Decoded)
    removes = arguments["remove"] == "true"
    if not removes:
        splits = [split for split in source.splits if source.has(split)]
        with shown() as advance:
            dataset.ensure(tuple(name for split in splits for name in source.names(split)), advance)
    for cache in dataset.caches():
        sys.stdout.write(f"{cache}: {gigabytes(size_of(cache))}{' removed' * removes}\n")
        if removes:
            remove(cache)
    return 0


if __name__ == "__main__":
    plain_command(OWN, main)()
