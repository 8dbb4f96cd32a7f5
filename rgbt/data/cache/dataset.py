"""A data set whose images are decoded once and then read from memory-mapped files.

Decoding a PNG of 480x640 pixels takes ten milliseconds; a view of the map takes almost no time, and
a crop of it reads only its own pages. Nothing is augmented here.

A cache is a sub-folder, named by the data set and a hash of everything that changes the decoded
images:

    about.json   class, decoding settings, fingerprint and version, and the root then
    *.frames     `rgbt.data.cache.sample_map`, one per call that found names in no other file
    lock         held while files are written; the system releases it with the process
"""

from __future__ import annotations

import errno
import hashlib
import json
import logging
import math
import os
import re
import shutil
from collections import deque
from collections.abc import Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.cache.sample_map import (
    NewSample,
    OnProgress,
    SampleMap,
    are_unchanged,
    state_of,
    write_map,
)
from rgbt.dataset import DatasetWrapper, LabelledDataset, layers
from rgbt.files.atomic import holder_of, holding, remove_left_behind
from rgbt.files.plain_files import read_json, write_json
from rgbt.types import Sample

LOG = logging.getLogger(__name__)

FORMAT = 3
"""Version of the file format, a part of the cache's key."""

ABOUT, LOCK = "about.json", "lock"

NO_FOLDERS = ("", "none", "null", "true", "false", "yes", "no", "on", "off")
"""Words that are refused as the name of a folder."""

WAYS_OUT = "or disable the cache with data.cache=null."


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total


def default_folder() -> Path:
    """$XDG_CACHE_HOME/rgbt/decoded, or ~/.cache/rgbt/decoded if that is not set."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "rgbt" / "decoded"


def check_cache(key: str, cache: object) -> None:
    """Refuse words such as "none" that would name a folder by mistake, and "", the current folder.

    `key` of the configuration begins the message; `cache` is as of `cached_dataset`.
    """
    if cache is None:
        return
    if not isinstance(cache, str) or cache.strip().lower() in NO_FOLDERS:
        raise InputError(
            f"{key}: {cache!r} is not a folder; expected auto or a folder (write ./NAME for a "
            f"folder of that name). Omit {key} to use no cache."
        )


def cached_dataset(
    dataset: LabelledDataset, cache: str | None, *, num_threads: int
) -> LabelledDataset:
    """`dataset`, or a `CachedDataset` of it; `num_threads` images are decoded at a time.

    `cache` is None, no cache; "auto", `default_folder`; or a folder.
    """
    if cache is None:
        return dataset
    folder = default_folder() if cache == "auto" else Path(cache).expanduser()
    return CachedDataset(dataset, folder, num_threads=num_threads)


def cached_layer(dataset: LabelledDataset) -> CachedDataset | None:
    """`dataset` itself or the data set behind it that reads from a cache; None without a cache."""
    return next((each for each in layers(dataset) if isinstance(each, CachedDataset)), None)


class CachedDataset(DatasetWrapper):
    """A data set whose samples are read from a cache after `ensure` has added them.

    The cache keeps length, times and CRC-32 of each file of a sample. If only the times differ the
    bytes are compared, so a copy of the data set elsewhere uses the same cache. A file of the cache
    with a changed sample, or a damaged one, is written again as a whole.

    Args:
        dataset: is decoded; its samples must not carry confidences.
        folder: holds caches; made when needed.
        num_threads: images decoded at a time, >= 1.
    """

    def __init__(self, dataset: LabelledDataset, folder: Path, *, num_threads: int) -> None:
        super().__init__(dataset)
        self.folder = Path(folder)
        self.num_threads = num_threads
        self._cached: dict[str, SampleMap] = {}
        self._unreadable: dict[str, str] = {}

    def ensure(self, names: tuple[str, ...], on_progress: OnProgress = _silent) -> None:
        """Decode those of `names` that are missing, changed or damaged, and use the cache for all.

        A sample that cannot be decoded is skipped; the next call tries again.

        Args:
            names: of any splits.
            on_progress: called with (name of the work, number done, total number).

        Raises:
            InputError: the cache cannot be written, or the disk is too small.
        """
        about = self._about()
        cache = self.folder / _cache_name(about)
        if not self._stale(cache, names, on_progress):
            return
        try:
            cache.mkdir(parents=True, exist_ok=True)
            with _alone(cache):
                # Once more: another process may have written it meanwhile.
                for path, (stale, size) in self._stale(cache, names, on_progress).items():
                    _check_space(cache, size * len(stale))
                    self._warn_of_others(cache, about)
                    write_json(cache / ABOUT, about)
                    write_map(path, self._decoded(stale, on_progress))
                    held = SampleMap(path)
                    self._cached |= {name: held for name in names if name in held.records}
        except OSError as error:
            full = error.errno in (errno.ENOSPC, errno.EDQUOT)
            raise InputError(
                f"data.cache: {f'the disk of {cache} is full' if full else f'cannot write {cache}'}"
                f" ({error.strerror or error}); {'free some space, ' * full}name a writable folder "
                f"with data.cache=FOLDER, {WAYS_OUT}"
            ) from error

    def read(self, name: str) -> Sample:
        """The sample as `source.read` returns it, with its InputError.

        Samples of `ensure` are read-only views of the cache; all others are decoded.
        """
        if name in self._unreadable:
            raise InputError(self._unreadable[name])
        if name in self._cached:
            with suppress(OSError, ValueError):  # somebody removed or replaced the file
                return self._cached[name].read(name)
        return self.source.read(name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W); None if the pair is unlabelled."""
        return self.read(name).label if name in self._cached else self.source.label(name)

    def caches(self) -> list[Path]:
        """Caches in `folder` of this data set, of former states of its files, and of versions."""
        return _caches_like(self.folder, self._about())

    def _about(self) -> dict[str, Any]:
        kind = type(self.source)
        about = {
            "format": FORMAT,
            "name": self.name,
            "class": f"{kind.__module__}.{kind.__qualname__}",
            "decoding": self.source.decoding(),
            "fingerprint": self.source.fingerprint(),
            "root": str(Path(self.root).resolve()),
        }
        # As read from a file, where tuples are lists.
        return dict(json.loads(json.dumps(about)))

    def _stale(
        self, cache: Path, names: Iterable[str], on_progress: OnProgress
    ) -> dict[Path, tuple[tuple[str, ...], int]]:
        """Files to write -> all their names, and bytes of a sample; samples of others are used.

        A file is written if one of its missing samples can be decoded.
        """
        left = dict.fromkeys(names)
        for name in left:
            self._cached.pop(name, None)
            self._unreadable.pop(name, None)
        stale = {}
        for held in self._maps(cache, on_progress):
            own = [name for name in left if name in held.records]
            fresh = self._unchanged(held, own)
            self._cached |= dict.fromkeys(fresh, held)
            if size := self._first_size(name for name in own if name not in fresh):
                stale[held.path] = (tuple(held.records), size)
            left = {name: None for name in left if name not in held.records}
        if size := self._first_size(left):
            key = hashlib.sha256("\n".join(left).encode()).hexdigest()[:16]
            stale[cache / f"{key}.frames"] = (tuple(left), size)
        return stale

    def _maps(self, cache: Path, on_progress: OnProgress) -> Iterator[SampleMap]:
        for path in sorted(cache.glob("*.frames")):
            with suppress(OSError, ValueError):  # damaged, not readable or just removed
                held = SampleMap(path)
                if held.is_intact(self.num_threads, on_progress):
                    yield held

    def _unchanged(self, held: SampleMap, names: list[str]) -> set[str]:
        """Those of `names` whose files are as they were when `held` was written."""

        def is_unchanged(name: str) -> bool:
            try:
                return are_unchanged(self.source.files(name), held.records[name].sources)
            except InputError:  # `_decode` raises it again and keeps the message
                return False

        with ThreadPoolExecutor(self.num_threads) as pool:
            results = pool.map(is_unchanged, names)
            return {name for name, unchanged in zip(names, results, strict=True) if unchanged}

    def _first_size(self, names: Iterable[str]) -> int:
        """Bytes of the first of `names` that can be decoded; 0 if none can."""
        found = (self._decode(name) for name in names)
        return next((each.record.num_bytes for each in found if each is not None), 0)

    def _decoded(self, names: tuple[str, ...], on_progress: OnProgress) -> Iterator[NewSample]:
        """Those of `names` that can be decoded, in order."""
        waiting: deque[Future[NewSample | None]] = deque()
        with ThreadPoolExecutor(self.num_threads) as pool:
            following = iter(names)
            for done in range(1, len(names) + 1):
                for name in islice(following, 1 + 2 * self.num_threads - len(waiting)):
                    waiting.append(pool.submit(self._decode, name))
                new = waiting.popleft().result()
                if new is not None:
                    yield new
                on_progress("decoding", done, len(names))

    def _decode(self, name: str) -> NewSample | None:
        try:
            # Before decoding, so that a change during decoding is noticed the next time.
            sources = tuple(state_of(path) for path in self.source.files(name))
            sample = self.source.read(name)
            _check_sample(sample)
        except InputError as error:
            self._unreadable[name] = str(error)
            return None
        except OSError as error:
            self._unreadable[name] = f"{error.filename or name}: {error.strerror or error}."
            return None
        assert sample.confidence is None, "pseudo-labels are added to the samples of the cache"
        return NewSample(replace(sample, name=name), sources)

    def _warn_of_others(self, cache: Path, about: dict[str, Any]) -> None:
        """Report once, before a new cache is written, that those of former states use space."""
        others = [path for path in _caches_like(self.folder, about) if path != cache]
        if others and not (cache / ABOUT).is_file():
            LOG.warning(
                "%s has changed, so %s is filled again and %s is kept. `rgbt cache ... "
                "remove=true` removes old caches.",
                *(self.name, cache, others[-1]),
            )


def _check_sample(sample: Sample) -> None:
    """Refuse a sample that the cache cannot hold; only a user's own data set returns one."""
    height, width = sample.thermal.shape[:2]
    expected = {"rgb": (height, width, 3), "thermal": (height, width), "label": (height, width)}
    for what, shape in expected.items():
        image = getattr(sample, what)
        if image is not None and (image.dtype != np.uint8 or image.shape != shape):
            raise InputError(
                f"'{sample.name}': {what} must be uint8 of shape {shape}, like the thermal image, "
                f"got {image.dtype} {image.shape}; correct the data set, or disable the cache "
                "(data.cache=null)."
            )


def _cache_name(about: dict[str, Any]) -> str:
    # Equal copies share one cache, whatever their root.
    same = {key: value for key, value in about.items() if key != "root"}
    key = hashlib.sha256(json.dumps(same, sort_keys=True).encode()).hexdigest()[:16]
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', about['name'])}-{key}"


def _caches_like(folder: Path, about: dict[str, Any]) -> list[Path]:
    """Caches in `folder` of the same data set, decoded alike, by any version of the format.

    The data set is the same if its files are equal, or if its root is.
    """
    alike = []
    for path in sorted(folder.glob(f"*/{ABOUT}")):
        with suppress(InputError):  # damaged or just removed
            other = read_json(path, dict[str, Any], "")
            differing = {key for key, value in about.items() if other.get(key) != value}
            if differing - {"format"} in (set(), {"fingerprint"}, {"root"}):
                alike.append(path.parent)
    return alike


def size_of(cache: Path) -> int:
    """Bytes of the files of a cache."""
    return sum(path.stat().st_size for path in cache.iterdir())


def remove(cache: Path) -> None:
    """Delete the files of a cache, of any version, and its folder if nothing else is in it."""
    for pattern in ("*.frames", ".*.frames.*", ABOUT, "verified.json", LOCK):
        for path in cache.glob(pattern):
            path.unlink(missing_ok=True)
    with suppress(OSError):
        cache.rmdir()


def gigabytes(num_bytes: int) -> str:
    """A size in decimal units: 2410000000 -> "2.41 GB", 1500000 -> "1.5 MB"."""
    return f"{num_bytes / 1e9:.2f} GB" if num_bytes >= 1e8 else f"{num_bytes / 1e6:.1f} MB"


@contextmanager
def _alone(cache: Path) -> Iterator[None]:
    """Lock the cache against other writers, if its disk supports locks."""
    with ExitStack() as locks:
        with suppress(OSError):  # no locks: two processes may do the same work
            writer = holder_of(cache / LOCK)
            if locks.enter_context(holding(cache / LOCK)) is not None:
                LOG.warning("waiting for another process that writes to %s", cache)
                locks.enter_context(holding(cache / LOCK, wait_s=math.inf))
            remove_left_behind(cache, writer)
        yield


def _check_space(cache: Path, needed: int) -> None:
    free = shutil.disk_usage(cache).free
    if free < needed:
        raise InputError(
            f"data.cache: the decoded images need about {gigabytes(needed)} in {cache}, but the "
            f"disk has {gigabytes(free)} left; free some space, name a folder on another disk with "
            f"data.cache=FOLDER, {WAYS_OUT}"
        )
