"""Compose a configuration once per choice of files; values are set on a copy.

Overrides such as ``masker=square`` choose files. Others, such as ``masker.block=16``, set values
after Hydra has merged the files, and have no part in the choice. Tables and searches compose many
configurations of the same files, and setting values on a copy is ten times faster.
"""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any

from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException
from omegaconf import DictConfig

from rgbt.config.config_source import FileState

MOST = 256
"""Compositions that are kept."""

HYDRA = "hydra"
"""Overrides of Hydra's own node may add folders, so they are never cached."""

Compose = Callable[[list[str]], DictConfig]
_composed: dict[tuple[Any, ...], bytes] = {}


def compose_cached(
    words: Sequence[str], values: Sequence[str], folders: Sequence[str], compose: Compose
) -> DictConfig:
    """The configuration of these overrides, as `compose` returns it.

    Args:
        words: overrides.
        values: keys at the top of the configuration that are plain values, such as "seed".
        folders: of configuration files; if a file changes, all is composed again.
        compose: composes by Hydra, without the node `hydra`.

    Raises:
        HydraException: a word that Hydra refuses.
    """
    divided = _divided(tuple(words), frozenset(values))
    if divided is None or any("://" in folder for folder in folders):
        return compose(list(words))
    chosen, rest = divided
    state = [each for folder in folders for each in _states(os.path.realpath(folder))]
    key = (chosen, tuple(folders), *state)
    if key not in _composed:
        if len(_composed) >= MOST:
            _composed.clear()
        _composed[key] = pickle.dumps(compose(list(chosen)))
    config: DictConfig = pickle.loads(_composed[key])  # noqa: S301 - made above
    # Hydra does the same after it has merged the files.
    ConfigLoaderImpl._apply_overrides_to_config(list(rest), config)
    return config


@lru_cache(maxsize=4096)
def _divided(
    words: tuple[str, ...], values: frozenset[str]
) -> tuple[tuple[str, ...], tuple[Override, ...]] | None:
    """The words that choose files, and the overrides that set values; None: do not cache."""
    chosen, rest = [], []
    for word in words:
        override = _parsed(word)
        if override is None or override.is_sweep_override():
            return None  # Hydra's own message follows
        key = override.key_or_group
        if key.partition(".")[0] == HYDRA or key.partition("/")[0] == HYDRA:
            return None
        if override.package is None and ("." in key or key in values):
            rest.append(override)
        elif isinstance(override.value(), dict):
            return None  # Hydra sets whole nodes in the order of the words
        else:
            chosen.append(word)
    return tuple(chosen), tuple(rest)


@lru_cache(maxsize=4096)
def _parsed(word: str) -> Override | None:
    try:
        return OverridesParser.create().parse_override(word)
    except HydraException:
        return None


def _states(folder: str) -> list[FileState]:
    """The state of every file in a folder, sorted; [] where there is none."""
    return sorted(_unsorted_states(folder))


def _unsorted_states(folder: str) -> Iterator[FileState]:
    # os.walk with a Path per file takes twice as long, for every composition.
    try:
        with os.scandir(folder) as listed:
            entries = list(listed)
    except (FileNotFoundError, NotADirectoryError):
        return
    for entry in entries:
        if entry.is_dir(follow_symlinks=False):
            yield from _unsorted_states(entry.path)
        elif entry.name.endswith(".yaml") and entry.name[0] != ".":
            with suppress(FileNotFoundError):  # removed since, or a link to nothing
                status = entry.stat()
                yield entry.path, status.st_mtime_ns, status.st_size, status.st_ino
