"""Folders of data sets that are written once and found again."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rgbt.checks import InputError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance


def default_cache() -> Path:
    """$XDG_CACHE_HOME/rgbt, or ~/.cache/rgbt where that is not set."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "rgbt"


def cache_of(cache_dir: str | None) -> Path:
    """The folder that the configuration names; None: `default_cache`."""
    return Path(cache_dir).expanduser() if cache_dir else default_cache()


def described(versions: Mapping[str, int], plan: DataclassInstance) -> str:
    """A plan and the versions of what writes it, as text: what the name of its folder hashes."""
    everything: dict[str, Any] = {**versions, **asdict(plan)}
    return json.dumps(everything, sort_keys=True, indent=1)


def key_of(text: str) -> str:
    """12 hexadecimal digits that name what is described."""
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def written_once(folder: Path, plan: str, write: Callable[[Path], None]) -> Path:
    """`folder`, written now if it is not there yet.

    It is written under another name and renamed when complete, so that an interrupted generation
    leaves nothing that looks like a data set, and two at once cannot mix.

    Args:
        folder: named by its content; its parents are made.
        plan: what it is made from, kept in it as plan.json.
        write: fills the empty folder that it is given.

    Raises:
        InputError: the cache cannot be written.
    """
    if folder.is_dir():
        return folder
    cache = folder.parent
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".synth-", dir=cache) as scratch:
            made = Path(scratch) / "made"
            made.mkdir()
            write(made)
            (made / "plan.json").write_text(plan + "\n", encoding="utf-8")
            _publish(made, folder)
    except OSError as error:
        raise InputError(
            f"dataset.cache_dir: cannot write {folder} ({error.strerror or error}); "
            "name a folder that can be written."
        ) from error
    return folder


def _publish(made: Path, folder: Path) -> None:
    try:
        made.rename(folder)
    except OSError:
        # Another process was first; equal plans give equal files, so its folder is as good.
        if not folder.is_dir():
            raise
