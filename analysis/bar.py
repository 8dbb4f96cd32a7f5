"""Work on many images: the progress bar of the commands, and threads."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Any, TypeVar

T = TypeVar("T")


@contextmanager
def progress(what: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on stderr; yields a function to call after each of `total` steps."""
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True)) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


def in_threads(work: Callable[..., T], *items: Iterable[Any], threads: int) -> Iterator[T]:
    """Results of `work` for all items, in order; the first error cancels items not yet started.

    Args:
        work: decodes, filters and sums, all of which run outside Python's lock.
        items: arguments of `work`, as for `map`.
        threads: their number; 0: one per core. The result does not depend on it.
    """
    with ThreadPoolExecutor(threads or os.cpu_count() or 1) as pool:
        try:
            yield from pool.map(work, *items)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
