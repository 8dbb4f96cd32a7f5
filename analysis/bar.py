"""Work on many images: the progress bar of the commands, and threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

from rich.console import Console
from rich.progress import Progress

T = TypeVar("T")


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on stderr; yields a function to call after each of `total` steps."""
    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def in_threads(work: Callable[..., T], *items: Iterable[Any], threads: int) -> Iterator[T]:
    """``map(work, *items)`` by threads (0: one per core), for work outside of Python's lock.

    The first error cancels items that have not started.
    """
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        try:
            yield from pool.map(work, *items)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
