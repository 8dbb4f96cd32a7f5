"""Sources of configuration files that parse each file once, as long as it does not change.

Hydra reads about 34 files for each composition, and parsing them takes half of its time. The parsed
file is kept as a pickle, because Hydra changes the objects that a source returns.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Hashable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path
from typing import Any

from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.core_plugins.importlib_resources_config_source import (
    ImportlibResourcesConfigSource,
)
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import _utils, base, grammar_parser

MOST_FILES = 4096
"""Parsed files that are kept; more of them empty the cache."""

FileState = tuple[str, int, int, int]
"""Path, time of the last change in ns, bytes, number of the file (another one after a rename)."""

_parsed: dict[Hashable, bytes] = {}


def file_state(path: Path) -> FileState:
    """What changes when a file does.

    Raises:
        OSError: there is no such file.
    """
    status = path.stat()
    return str(path), status.st_mtime_ns, status.st_size, status.st_ino


class ParsedFileSource(FileConfigSource):
    """A folder of configuration files."""

    def load_config(self, config_path: str) -> ConfigResult:
        """The file, parsed again if it has changed."""
        name = self._normalize_file_name(config_path)
        path = Path(self.path, name).resolve()
        if not path.exists():
            return super().load_config(config_path)  # its error names the file
        key = file_state(path)  # before it is read: a later change has another state
        return _loaded(
            (self.path, self.provider, key), lambda: FileConfigSource.load_config(self, name)
        )


class ParsedPackageSource(ImportlibResourcesConfigSource):
    """Configuration files inside a Python package, which do not change."""

    def load_config(self, config_path: str) -> ConfigResult:
        """The file."""
        key = (self.path, self.provider, config_path)
        load = super().load_config
        return _loaded(key, lambda: load(config_path))


def _loaded(key: Hashable, load: Callable[[], ConfigResult]) -> ConfigResult:
    """The result of `load`, a copy of its own for each call."""
    if key not in _parsed:
        if len(_parsed) >= MOST_FILES:
            _parsed.clear()
        _parsed[key] = pickle.dumps(load())
    result: ConfigResult = pickle.loads(_parsed[key])  # noqa: S301 - made above
    return result


def parse_interpolations_once() -> None:
    """Let OmegaConf keep the parse trees of texts such as ``${scale.crop_hw}``.

    It parses the same 300 texts again for every configuration, which takes a fifth of the time.
    The trees are only read.
    """
    if not hasattr(grammar_parser.parse, "cache_info"):
        kept = lru_cache(maxsize=MOST_FILES)(grammar_parser.parse)
        modules: tuple[Any, ...] = (grammar_parser, base, _utils)
        for module in modules:
            module.parse = kept


@contextmanager
def parsing_once() -> Iterator[None]:
    """Let Hydra read files and packages by the sources above."""
    Plugins.instance()  # registers Hydra's own sources, once
    types: dict[str, Any] = SourcesRegistry.instance().types
    own = {"file": ParsedFileSource, "pkg": ParsedPackageSource}
    before = {scheme: types.get(scheme) for scheme in own}
    types.update(own)
    try:
        yield
    finally:
        types.update({scheme: source for scheme, source in before.items() if source is not None})
