"""Leave out work of Hydra in tests: it does not change a composition and takes half of its time.

For every file, Hydra makes the table of choices that interpolations in its defaults list may name,
also where the list has none. It copies the content of every file into its package, also where
nothing else uses it. And it corrects the parents of all nodes after each of about 34 files is
merged, where once at the end is enough.

Only tests use this, which compose some thousand times: it replaces private functions of the version
that `constraints.txt` names. `tests/test_quick_hydra.py` compares with Hydra itself.
"""

from __future__ import annotations

import copy
from typing import Any

from hydra._internal import config_loader_impl, defaults_list
from hydra.core.default_element import GroupDefault, InputDefault, ResultDefault
from hydra.plugins.config_source import ConfigResult
from omegaconf import DictConfig, OmegaConf, flag_override
from omegaconf.errors import OmegaConfBaseException

_every_choice = defaults_list._create_interpolation_map
_merge_one_by_one = config_loader_impl.ConfigLoaderImpl._compose_config_from_defaults_list
_embed_copy = config_loader_impl.ConfigLoaderImpl._embed_result_config


def make_hydra_quick() -> None:
    """Replace these functions of Hydra in this process."""
    loader: Any = config_loader_impl.ConfigLoaderImpl
    lists: Any = defaults_list
    lists._create_interpolation_map = _choices
    loader._compose_config_from_defaults_list = _merged
    loader._embed_result_config = staticmethod(_embedded)


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
