"""Leave out work of Hydra in tests: it does not change a composition and takes half of its time.

For every file, Hydra makes the table of choices that interpolations in its defaults list may name,
also where the list has none. It copies the content of every file into its package, also where
nothing else uses it. And it corrects the parents of all nodes after each of about 34 files is
merged, where once at the end is enough. A command that is called in this process composes its files
once, as `rgbt.config.compose_cache` does for all other compositions. OmegaConf copies the types and
flags of every node as it copies any object.

Only tests use this, which compose some thousand times: it replaces private functions of the version
that `constraints.txt` names. `tests/test_quick_hydra.py` compares with Hydra itself.
"""

from __future__ import annotations

import copy
import pickle
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from hydra._internal import config_loader_impl, defaults_list
from hydra.core.default_element import GroupDefault, InputDefault, ResultDefault
from hydra.core.utils import JobRuntime
from hydra.errors import HydraException
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.base import Metadata
from omegaconf.errors import OmegaConfBaseException

from rgbt.config.compose import conf_dir, own_folders, top_level
from rgbt.config.compose_cache import _divided, _parsed, _states

_every_choice = defaults_list._create_interpolation_map
_merge_one_by_one = config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list
_embed_copy = config_loader_impl.ConfigLoaderImpl._embed_result_config
_load = config_loader_impl.ConfigLoaderImpl._load_configuration_impl

HYDRAS = ("hydra/sweeper=", "hydra.mode=")
"""Beginnings of the words about Hydra itself that every command has."""

_commands: dict[tuple[Any, ...], bytes] = {}
"""Configurations of commands before values are set, by the files and the words that choose them."""


def make_hydra_quick() -> None:
    """Replace these functions of Hydra in this process."""
    loader: Any = config_loader_impl.ConfigLoaderImpl
    lists: Any = defaults_list
    lists._create_interpolation_map = _choices
    loader._compose_config_from_defaults_list = _merged
    loader._embed_result_config = staticmethod(_embedded)
    loader._load_configuration_impl = _loaded
    metadata: Any = Metadata
    metadata.__deepcopy__ = _copied


def _copied(metadata: Metadata, memo: dict[int, Any]) -> Metadata:
    """A copy of what OmegaConf knows about a node: types, flags and values of resolvers."""
    copied = copy.copy(metadata)
    copied.flags = dict(metadata.flags or {})
    copied.resolver_cache = copy.deepcopy(metadata.resolver_cache, memo)
    return copied


def _choices(overrides: Any, defaults: list[InputDefault], self_added: bool) -> DictConfig:
    """The table of choices where a default names one, which is its only use."""
    if any(_is_interpolation(default) for default in defaults):
        return _every_choice(overrides, defaults, self_added)
    return OmegaConf.create()


def _is_interpolation(default: InputDefault) -> bool:
    has_options = isinstance(default, GroupDefault) and default.is_options()
    return not has_options and default.is_interpolation()


def _embedded(file: ConfigResult, package_override: str | None) -> ConfigResult:
    """The content of a file in its package; a copy if the file has another package already."""
    package = file.header["package"] if package_override is None else package_override
    if not package:
        return file
    config = OmegaConf.create()
    is_first = file.config._get_parent() is None
    with flag_override(config, "no_deepcopy_set_nodes", is_first or None):
        OmegaConf.update(config, package, file.config, merge=False)
    embedded = copy.copy(file)
    embedded.config = config
    return embedded


class _MergedFiles:
    """In the place of Hydra's loader: all files as one."""

    def __init__(self, config: DictConfig) -> None:
        self._config = config

    def _load_single_config(self, **_: Any) -> ConfigResult:
        return ConfigResult(provider="", path="", config=self._config, header={})


def _merged(loader: Any, defaults: list[ResultDefault], repo: Any) -> DictConfig:
    """All files merged by one call; Hydra merges again where one is refused, to name it."""
    config = OmegaConf.create()
    files = [loader._load_single_config(default=each, repo=repo).config for each in defaults]
    try:
        with flag_override(config, "no_deepcopy_set_nodes", True):
            config.merge_with(*files)
    except OmegaConfBaseException:
        repo.cache.clear()  # the files have been merged into each other
        return _merge_one_by_one(loader, defaults, repo)
    stand_in: Any = _MergedFiles(config)
    return _merge_one_by_one(stand_in, [ResultDefault()], repo)


def _loaded(
    loader: Any,
    config_name: str,
    overrides: list[str],
    run_mode: RunMode,
    from_shell: bool = True,
    validate_sweep_overrides: bool = True,
) -> DictConfig:
    """The configuration of a command: its values are set in a copy of what its files give."""
    given = (run_mode, from_shell, validate_sweep_overrides)
    hydras = [word for word in overrides if word.startswith(HYDRAS)]
    others = tuple(word for word in overrides if word not in hydras)
    divided = _divided(others, frozenset(top_level()[1]))
    if divided is None or not from_shell or run_mode != RunMode.RUN or own_folders():
        return _load(loader, config_name, overrides, *given)
    chosen, values = [*hydras, *divided[0]], divided[1]
    searched = [(each.provider, each.path) for each in loader.get_search_path().get_path()]
    key = (config_name, *chosen, *searched, *_states(str(conf_dir())))
    if key not in _commands:
        try:
            _commands[key] = pickle.dumps(_load(loader, config_name, chosen, *given))
        except (HydraException, OmegaConfBaseException):  # it names the first of all words
            return _load(loader, config_name, overrides, *given)
    config: DictConfig = pickle.loads(_commands[key])
    loader._apply_overrides_to_config(values, config)
    _note_command(config, others)
    return config


def _note_command(config: DictConfig, words: Sequence[str]) -> None:
    """What Hydra notes about a command: all its words in their order, and where it was called."""
    job, options = config.hydra.job, config.hydra.job.config.override_dirname
    parsed = [override for override in map(_parsed, words) if override is not None]
    config.hydra.overrides.task = list(words)
    config.hydra.runtime.cwd = str(Path.cwd())
    job.name = JobRuntime().get("name")
    job.override_dirname = config_loader_impl.get_overrides_dirname(
        parsed,
        kv_sep=options.kv_sep,
        item_sep=options.item_sep,
        exclude_keys=options.exclude_keys,
    )
