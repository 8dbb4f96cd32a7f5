"""Remember which runs the rows of tables request: composing them takes longer than judging them.

A specification lies in the cache of the user as plain JSON, under a digest of all that decides it:
its words, every file of ``conf/``, the code of rgbt, the versions of Hydra and OmegaConf. So a
changed file never gives an old answer. It only says which finished runs belong to a row, by their
keys: what is trained or built is composed.
"""

from __future__ import annotations

import hashlib
import json
import os
import time
from collections.abc import Iterator, Mapping
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
PACKAGES = ("hydra-core", "omegaconf")

# Nanoseconds on the clock of the file system when this process had read none of the files: a second
# less than now, because that clock moves in steps.
STARTED = time.time_ns() - 10**9


def stored(words: tuple[str, ...]) -> RunSpec | None:
    """Return the specification that the same words and files made before; None: not stored.

    Folders of a user's own files, and words about Hydra, are not stored.
    """
    path = _place(words)
    if path is None or not path.is_file():
        return None
    try:
        return _spec_of(read_json(path, dict[str, Any], "it is made again"))
    except (InputError, KeyError, TypeError, ValueError):
        return None  # damaged; it is composed, and written again


def store(words: tuple[str, ...], spec: RunSpec) -> None:
    """Keep what `words` make, unless JSON would change it or a file may have changed meanwhile."""
    path, plain = _place(words), sealed(_plain_of(spec))
    if path is None or repr(_plain_of(_spec_of(plain))) != repr(_plain_of(spec)):
        return
    if not _is_settled():
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, json.dumps(plain).encode())
    except OSError:
        return  # no cache of the user can be written: every process composes


def _place(words: tuple[str, ...]) -> Path | None:
    """Return the file of the words; None: they have none."""
    if own_folders() or any("hydra" in word for word in words):
        return None
    files = _digest_of_files(str(conf_dir()))
    if not files:
        return None
    name = hashlib.sha256(json.dumps(words).encode()).hexdigest()[:16]
    return _folder() / files / f"{name}.json"


def _folder() -> Path:
    home = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(home, "rgbt", FOLDER)


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
