"""Remember what the rows of tables request: composing them takes longer than judging them.

Specifications of runs and sizes of networks lie in the cache of the user as plain JSON, under a
digest of all that decides them: their words, every file of ``conf/``, the code of rgbt, the
versions of the packages that compose and build. So a changed file never gives an old answer. They
only say which finished runs belong to a row, by their keys: what is trained or built is composed.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import Any

import rgbt
from rgbt.checks import InputError
from rgbt.config.compose import conf_dir, own_folders
from rgbt.files.atomic import write_atomic
from rgbt.files.plain_files import read_json, sealed
from rgbt.runs.run_spec import Dependency, RunSpec

FOLDER = "rows"  # in the cache of rgbt
PACKAGES = ("hydra-core", "omegaconf", "torch")
SIZE = "million parameters"
OUTSIDE = ("hydra", "checkout", "external", "_target_")  # words of files or code of others

# Nanoseconds on the clock of the file system when this process had read none of the files: a second
# less than now, because that clock moves in steps.
STARTED = time.time_ns() - 10**9


def requested(words: tuple[str, ...], compose: Callable[[], RunSpec]) -> RunSpec:
    """Return the specification that `compose` makes of words, or made of them before."""
    plain = _read("run", words)
    if plain is not None:
        return _spec_of(plain)
    spec = compose()
    _write("run", words, _plain_of(spec))
    return spec


def size(words: tuple[str, ...], count: Callable[[], float]) -> float:
    """Return the millions of parameters that `count` finds for words, or found before."""
    plain = _read("size", words)
    if plain is not None:
        return float(plain[SIZE])
    found = count()
    _write("size", words, {SIZE: found})
    return found


def _read(kind: str, words: tuple[str, ...]) -> dict[str, Any] | None:
    """Return what is stored; None: nothing, or a damaged file, which is written again."""
    path = _place(kind, words)
    if path is None or not path.is_file():
        return None
    try:
        found: dict[str, Any] = read_json(path, dict[str, Any], "it is made again")
    except InputError:
        return None
    return found


def _write(kind: str, words: tuple[str, ...], plain: dict[str, Any]) -> None:
    """Store `plain`, unless JSON would change it or a file may have changed meanwhile."""
    path, content = _place(kind, words), sealed(plain)
    kept = {key: value for key, value in content.items() if key in plain}
    if path is None or repr(kept) != repr(plain) or not _is_settled():
        return
    with suppress(OSError):  # a cache that cannot be written: every process composes
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(content).encode())


def _place(kind: str, words: tuple[str, ...]) -> Path | None:
    """Return the file of the words; None: what they make depends on further files of the user."""
    if own_folders() or any(mark in word for word in words for mark in OUTSIDE):
        return None
    files = _digest_of_files(str(conf_dir()))
    if not files:
        return None
    name = hashlib.sha256(json.dumps(words).encode()).hexdigest()[:16]
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "rgbt", FOLDER, files, f"{kind}-{name}.json")


@cache
def _digest_of_files(conf: str) -> str:
    """Digest all that decides a specification; "": a file may have changed since the start."""
    del conf  # one of `_files`
    if not _is_settled():
        return ""
    digest = hashlib.sha256()
    for name in PACKAGES:
        digest.update(f"{name} {metadata.version(name)}\n".encode())
    for path in _files():
        digest.update(f"{path} {path.stat().st_size}\n".encode())
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _files() -> Iterator[Path]:
    """Every file of ``conf/`` and of the code that composes."""
    yield from sorted(conf_dir().rglob("*.yaml"))
    yield from sorted(Path(rgbt.__file__).parent.rglob("*.py"))


def _is_settled() -> bool:
    """Whether no file has changed since this process started, so that all of it read the same.

    The change time of a file cannot be set, unlike its modification time.
    """
    folders = {path.parent for path in _files()}
    return all(path.stat().st_ctime_ns < STARTED for path in (*folders, *_files()))


def _plain_of(spec: RunSpec) -> dict[str, Any]:
    upstream = []
    for found in spec.dependencies:
        upstream.append([found.key, _plain_of(found.run), found.checkpoint, found.is_common])
    return {
        "plain": spec.plain,
        "overrides": list(spec.overrides),
        "fresh": spec.fresh,
        "dependencies": upstream,
    }


def _spec_of(plain: Mapping[str, Any]) -> RunSpec:
    upstream = []
    for key, run, checkpoint, is_common in plain["dependencies"]:
        upstream.append(Dependency(key, _spec_of(run), checkpoint, is_common))
    return RunSpec(
        plain=plain["plain"],
        overrides=tuple(plain["overrides"]),
        dependencies=tuple(upstream),
        fresh=plain["fresh"],
    )
