"""Frames that are decoded once and then read from a map of memory.

`Decoded` stands before a data set and is one. Decoding a PNG of 480x640 pixels takes ten
milliseconds, a view of the map none to speak of, and a cut of it touches only its own pages.
Nothing is augmented here, and nothing is kept that the data set would not return today: a frame is
decoded again when one of its files changes, or when its bytes in the cache are damaged.
"""

from __future__ import annotations

import hashlib
import json
import logging
import re
from collections import deque
from collections.abc import Generator, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.cache.file import bytes_of, crc_of
from rgbt.data.cache.stamps import is_fresh, stamp_of
from rgbt.data.cache.store import (
    FINGERPRINT,
    ROOT,
    Fresh,
    Placed,
    Store,
    Told,
    stores_like,
)
from rgbt.data.dataset import LabelledDataset
from rgbt.data.synth.cache import default_cache
from rgbt.requirements import Record, record_of
from rgbt.types import Sample

LOG = logging.getLogger(__name__)

FORMAT = 2
"""Part of the key; rises when the files are laid out otherwise."""

NO_FOLDERS = ("", "none", "null", "true", "false", "yes", "no", "on", "off")
"""What people type who do not mean a folder."""


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total


def default_folder() -> Path:
    """$XDG_CACHE_HOME/rgbt/decoded, or ~/.cache/rgbt/decoded where that is not set."""
    return default_cache() / "decoded"


def check_cache(key: str, cache: object) -> None:
    """Refuse words that would name a folder by mistake: "" is the current one.

    Args:
        key: of the configuration, for the message.
        cache: as `decoded_dataset` takes it.

    Raises:
        InputError: no text, an empty one, or a word for nothing such as "none".
    """
    if cache is None:
        return
    if not isinstance(cache, str) or cache.strip().lower() in NO_FOLDERS:
        raise InputError(
            f"{key}: {cache!r} names no folder; expected auto or a folder (./NAME where it is "
            f"called so), or omit {key}."
        )


def decoded_dataset(
    dataset: LabelledDataset, cache: str | None, *, num_threads: int
) -> LabelledDataset:
    """`dataset`, or a `Decoded` before it.

    Args:
        dataset: reads files.
        cache: None: no cache; "auto": `default_folder`; otherwise a folder.
        num_threads: frames decoded at a time when the cache is filled.
    """
    if cache is None:
        return dataset
    folder = default_folder() if cache == "auto" else Path(cache).expanduser()
    return Decoded(dataset, folder, num_threads=num_threads)


class Decoded:
    """A data set whose frames come from a cache, once `ensure` has put them there.

    The cache is a folder in `folder`, named by the data set's class, `decoding()`, `fingerprint()`
    and the version of the format. Of every frame the length and the time of change of its files
    are kept, and a CRC-32 of their bytes: where only the time differs the bytes are compared, so
    that a copy of the data set elsewhere finds the same cache. When files are changed so that the
    fingerprint is another one, the new cache takes the frames that are the same from the old one;
    the old one stays until somebody removes it. An old one is known by the folder of the data set:
    other data sets of the same name are nobody's earlier state.

    Args:
        dataset: what is decoded; its samples must not carry confidences.
        folder: where caches lie, made when needed.
        num_threads: frames decoded at a time, >= 1.

    Attributes:
        source: the data set.
    """

    def __init__(self, dataset: LabelledDataset, folder: Path, *, num_threads: int) -> None:
        self.source = dataset
        self.folder = Path(folder)
        self.num_threads = num_threads
        self.root = dataset.root
        self.name = dataset.name
        self.num_classes = dataset.num_classes
        self.classes = dataset.classes
        self.palette = dataset.palette
        self.unscored = dataset.unscored
        self._placed: dict[str, Placed] = {}
        self._unreadable: dict[str, str] = {}

    @property
    def record(self) -> Record:
        """That of the data set, with a cache."""
        return replace(record_of(self.source), fill_cache=self.ensure)

    def ensure(self, names: tuple[str, ...], advance: Told = _silent) -> None:
        """Make `read` take `names` from the cache; decodes what is missing, changed or damaged.

        A frame that cannot be decoded is left out, and is tried again by the next call.

        Args:
            names: of any splits.
            advance: called as (what is being done, how many are done, of how many).

        Raises:
            InputError: the cache cannot be written, or the disk is too small for it.
        """
        wanted = tuple(dict.fromkeys(names))
        for name in wanted:
            self._placed.pop(name, None)
            self._unreadable.pop(name, None)
        about = self._about()
        store = Store(self.folder / _store_name(about), about, self.num_threads)
        store.load(advance)
        size = self._first_size(self._missing(store, wanted))
        if size is not None:
            with store.building():
                self._adopt(store)
                store.load(advance)
                missing = self._missing(store, wanted)
                store.check_space(size * len(missing))
                with closing(self._fresh(missing, advance)) as frames:
                    store.add(frames)
        self._placed |= {name: store.frames[name] for name in wanted if name in store.frames}

    def read(self, name: str) -> Sample:
        """The sample as `source.read` returns it.

        Names that `ensure` was given come as read-only views of the cache, all others are decoded.

        Raises:
            InputError: it could not be decoded, in the words of the data set.
        """
        if name in self._unreadable:
            raise InputError(self._unreadable[name])
        if name in self._placed:
            file, frame = self._placed[name]
            with suppress(OSError, ValueError):  # somebody removed the cache
                return file.read(frame)
        return self.source.read(name)

    def label(self, name: str) -> NDArray[np.uint8] | None:
        """The label of `read` alone, (H, W); None where the pair is unlabelled."""
        return self.read(name).label if name in self._placed else self.source.label(name)

    @property
    def splits(self) -> Mapping[str, str]:
        """As the data set says."""
        return self.source.splits

    def has(self, split: str) -> bool:
        """As the data set says."""
        return self.source.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """As the data set says."""
        return self.source.names(split)

    def files(self, name: str) -> tuple[Path, ...]:
        """As the data set says: the files that were decoded, not those of the cache."""
        return self.source.files(name)

    def decoding(self) -> dict[str, Any]:
        """As the data set says."""
        return self.source.decoding()

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """As the data set says."""
        return self.source.nights(names)

    def fingerprint(self) -> str:
        """As the data set says."""
        return self.source.fingerprint()

    def caches(self) -> list[Path]:
        """Caches in `folder` of this data set, those of earlier states of its folder too."""
        return stores_like(self.folder, self._about())

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
        # As it comes back from a file: tuples are lists there.
        return dict(json.loads(json.dumps(about)))

    def _missing(self, store: Store, names: tuple[str, ...]) -> list[str]:
        """Names that are not in `store`, or whose files have changed since."""

        def is_missing(name: str) -> bool:
            placed = store.frames.get(name)
            if placed is None:
                return True
            try:
                return not is_fresh(self.source.files(name), placed.frame.stamps)
            except InputError:  # `_decode` finds out again, and keeps the sentence
                return True

        with ThreadPoolExecutor(self.num_threads) as pool:
            found = pool.map(is_missing, names)
            return [name for name, missing in zip(names, found, strict=True) if missing]

    def _first_size(self, names: list[str]) -> int | None:
        """Bytes of the first of `names` that can be decoded; None where none can.

        So a cache that lacks nothing but damaged frames is not written to.
        """
        for result in self._results(names):
            if result is not None:
                return bytes_of(result.sample)
        return None

    def _fresh(self, names: list[str], advance: Told) -> Generator[Fresh]:
        for done, result in enumerate(self._results(names), 1):
            if result is not None:
                yield result
            advance("decoding", done, len(names))

    def _results(self, names: list[str]) -> Iterator[Fresh | None]:
        """Each of `names` decoded, in order; None where that cannot be done."""
        waiting: deque[Future[Fresh | None]] = deque()
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

    def _decode(self, name: str) -> Fresh | None:
        try:
            # Before decoding: a file that changes meanwhile has another stamp the next time.
            stamps = tuple(stamp_of(path) for path in self.source.files(name))
            sample = self.source.read(name)
            _check_kept(sample)
        except InputError as error:
            self._unreadable[name] = str(error)
            return None
        except OSError as error:
            self._unreadable[name] = f"{error.filename or name}: {error.strerror or error}."
            return None
        assert sample.confidence is None, "pseudo-labels are joined to what the cache returns"
        return Fresh(replace(sample, name=name), crc_of(sample), stamps)

    def _adopt(self, store: Store) -> None:
        """Let a new store begin with the files of the one that was last used before it."""
        if store.frames:
            return
        like = [path for path in self.caches() if path != store.folder]
        if like:
            latest = max(like, key=lambda path: path.stat().st_mtime_ns)
            store.adopt(latest)
            LOG.warning(
                "%s has changed: %s takes what is the same from %s, which stays; "
                "python -m rgbt.data.cache ... remove=true removes such caches.",
                *(self.name, store.folder, latest),
            )


def _check_kept(sample: Sample) -> None:
    """Refuse what the cache cannot hold; only readers of one's own make such samples."""
    height, width = sample.thermal.shape[:2]
    expected = {"rgb": (height, width, 3), "thermal": (height, width), "label": (height, width)}
    for what, shape in expected.items():
        image = getattr(sample, what)
        if image is not None and (image.dtype != np.uint8 or image.shape != shape):
            raise InputError(
                f"'{sample.name}': {what} must be uint8 of shape {shape}, like the thermal image, "
                f"got {image.dtype} {image.shape}; the cache holds nothing else, read without it "
                "(data.cache=null)."
            )


def _store_name(about: dict[str, Any]) -> str:
    # Equal copies are one cache, wherever they lie.
    same = {key: value for key, value in about.items() if key != ROOT}
    key = hashlib.sha256(json.dumps(same, sort_keys=True).encode()).hexdigest()[:16]
    return f"{re.sub(r'[^A-Za-z0-9_-]', '_', about['name'])}-{key}"
