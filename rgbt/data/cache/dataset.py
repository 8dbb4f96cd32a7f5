"""A data set whose images are decoded once and then read from memory-mapped files.

Decoding a PNG of 480x640 pixels takes ten milliseconds; a view of the map takes almost no time, and
a crop of it reads only its own pages. Nothing is augmented here. A sample is decoded again when one
of its files changes, or when its bytes in the cache are damaged.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.cache.file_state import are_unchanged, state_of
from rgbt.data.cache.folder import (
    FINGERPRINT,
    ROOT,
    CachedSample,
    CacheFolder,
    NewSample,
    OnProgress,
    caches_like,
)
from rgbt.data.cache.sample_file import bytes_of, crc_of
from rgbt.data.synth.cache import default_cache
from rgbt.dataset import DatasetWrapper, LabelledDataset, layers
from rgbt.types import Sample

LOG = logging.getLogger(__name__)

FORMAT = 2
"""Version of the file format, a part of the cache's key."""

NO_FOLDERS = ("", "none", "null", "true", "false", "yes", "no", "on", "off")
"""Words that are not accepted as the name of a folder."""


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total


def default_folder() -> Path:
    """$XDG_CACHE_HOME/rgbt/decoded, or ~/.cache/rgbt/decoded if that is not set."""
    return default_cache() / "decoded"


def check_cache(key: str, cache: object) -> None:
    """Refuse words such as "none" that would name a folder by mistake, and "", the current folder.

    `key` of the configuration begins the message; `cache` is as of `cached_dataset`.
    """
    if cache is None:
        return
    if not isinstance(cache, str) or cache.strip().lower() in NO_FOLDERS:
        raise InputError(
            f"{key}: {cache!r} is not a folder; expected auto or a folder (./NAME if that is its "
            f"name), or omit {key}."
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

    The cache is a sub-folder of `folder`, named by the class, `decoding()` and `fingerprint()` of
    the data set and the version of the format. The cache keeps length, times and CRC-32 of each
    file of a sample. If only the times differ the bytes are compared, so a copy of the data set
    elsewhere uses the same cache. If files change so that the fingerprint changes, the new cache
    takes the unchanged samples from the old one, which is kept until somebody removes it. The old
    cache is the one with the same root; other data sets of the same name are never used.

    Args:
        dataset: is decoded; its samples must not carry confidences.
        folder: holds caches; made when needed.
        num_threads: images decoded at a time, >= 1.
    """

    def __init__(self, dataset: LabelledDataset, folder: Path, *, num_threads: int) -> None:
        super().__init__(dataset)
        self.folder = Path(folder)
        self.num_threads = num_threads
        self._cached: dict[str, CachedSample] = {}
        self._unreadable: dict[str, str] = {}

    def ensure(self, names: tuple[str, ...], on_progress: OnProgress = _silent) -> None:
        """Decode those of `names` that are missing, changed or damaged, and use the cache for all.

        A sample that cannot be decoded is left out; the next call tries again.

        Args:
            names: of any splits.
            on_progress: called with (name of the work, number done, total number).

        Raises:
            InputError: the cache cannot be written, or the disk is too small.
        """
        wanted = tuple(dict.fromkeys(names))
        for name in wanted:
            self._cached.pop(name, None)
            self._unreadable.pop(name, None)
        about = self._about()
        cache = CacheFolder(self.folder / _cache_name(about), about, self.num_threads)
        cache.load(on_progress)
        size = self._first_size(self._missing(cache, wanted))
        if size is not None:
            with cache.building():
                self._adopt(cache)
                cache.load(on_progress)
                missing = self._missing(cache, wanted)
                cache.check_space(size * len(missing))
                with closing(self._decode_all(missing, on_progress)) as samples:
                    cache.add(samples)
        self._cached |= {name: cache.samples[name] for name in wanted if name in cache.samples}

    def read(self, name: str) -> Sample:
        """The sample as `source.read` returns it, with its InputError.

        Samples of `ensure` are read-only views of the cache; all others are decoded.
        """
        if name in self._unreadable:
            raise InputError(self._unreadable[name])
        if name in self._cached:
            file, record = self._cached[name]
            with suppress(OSError, ValueError):  # somebody removed the cache
                return file.read(record)
        return self.source.read(name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W); None if the pair is unlabelled."""
        return self.read(name).label if name in self._cached else self.source.label(name)

    def caches(self) -> list[Path]:
        """Caches in `folder` of this data set, and of former states of its files."""
        return caches_like(self.folder, self._about())

    def _about(self) -> dict[str, Any]:
        kind = type(self.source)
        about = {
            "format": FORMAT,
            "name": self.name,
            "class": f"{kind.__module__}.{kind.__qualname__}",
            "decoding": self.source.decoding(),
            FINGERPRINT: self.source.fingerprint(),
            ROOT: str(Path(self.root).resolve()),
        }
        # As read from a file, where tuples are lists.
        return dict(json.loads(json.dumps(about)))

    def _missing(self, cache: CacheFolder, names: tuple[str, ...]) -> list[str]:
        """Names that are not in `cache`, or whose files have changed since."""

        def is_missing(name: str) -> bool:
            cached = cache.samples.get(name)
            if cached is None:
                return True
            try:
                return not are_unchanged(self.source.files(name), cached.record.sources)
            except InputError:  # `_decode` raises it again and keeps the message
                return True

        with ThreadPoolExecutor(self.num_threads) as pool:
            results = pool.map(is_missing, names)
            return [name for name, missing in zip(names, results, strict=True) if missing]

    def _first_size(self, names: list[str]) -> int | None:
        """Bytes of the first of `names` that can be decoded; None if none can.

        A cache in which only undecodable samples are missing is not written to.
        """
        for result in self._results(names):
            if result is not None:
                return bytes_of(result.sample)
        return None

    def _decode_all(self, names: list[str], on_progress: OnProgress) -> Generator[NewSample]:
        for done, result in enumerate(self._results(names), 1):
            if result is not None:
                yield result
            on_progress("decoding", done, len(names))

    def _results(self, names: list[str]) -> Iterator[NewSample | None]:
        """Each of `names` decoded, in order; None for one that cannot be decoded."""
        waiting: deque[Future[NewSample | None]] = deque()
        pool = ThreadPoolExecutor(self.num_threads)
        try:
            for name in names:
                waiting.append(pool.submit(self._decode, name))
                if len(waiting) > 2 * self.num_threads:
                    yield waiting.popleft().result()
            while waiting:
                yield waiting.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

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
        return NewSample(replace(sample, name=name), crc_of(sample), sources)

    def _adopt(self, cache: CacheFolder) -> None:
        """Start a new cache with the files of the most recent cache of the same data set."""
        if cache.samples:
            return
        alike = [path for path in self.caches() if path != cache.folder]
        if alike:
            latest = max(alike, key=lambda path: path.stat().st_mtime_ns)
            cache.adopt(latest)
            LOG.warning(
                "%s has changed: %s takes the unchanged images from %s, which is kept; "
                "rgbt cache ... remove=true removes such caches.",
                *(self.name, cache.folder, latest),
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
                f"got {image.dtype} {image.shape}; correct the data set, or read without the "
                "cache (data.cache=null)."
            )


def _cache_name(about: dict[str, Any]) -> str:
    # Equal copies share one cache, whatever their root.
    same = {key: value for key, value in about.items() if key != ROOT}
    key = hashlib.sha256(json.dumps(same, sort_keys=True).encode()).hexdigest()[:16]
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', about['name'])}-{key}"
