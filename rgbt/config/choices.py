"""Which files of a group could be chosen instead, each as it would be in a given configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf

from rgbt.config.compose import own_hydra, register_resolvers


def choices(plain: Mapping[str, Any], group: str) -> Iterator[tuple[str, DictConfig]]:
    """The files of ``conf/<group>/`` and of `hydra.searchpath`: name, and the node that each makes.

    Args:
        plain: the configuration that interpolations of the files refer to, as resolved values.
        group: key of the node, which is the name of its folder.
    """
    register_resolvers()
    path = list(HydraConfig.get().searchpath) if HydraConfig.initialized() else []
    words = (f"hydra.searchpath=[{','.join(path)}]",) if path else ()
    changed = OmegaConf.create(dict(plain))
    with own_hydra():
        loader = GlobalHydra.instance().config_loader()
        names = loader.get_group_options(group, config_name="config", overrides=list(words))
    for name in names:
        changed[group] = _node(group, name, words)
        yield name, changed[group]


@cache
def _node(group: str, name: str, words: tuple[str, ...]) -> DictConfig:
    with own_hydra():
        node: DictConfig = hydra.compose(f"{group}/{name}", list(words))[group]
    return node
