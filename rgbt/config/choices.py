"""Which files of a group could be chosen instead, each as it would be in a given configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
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
    path = search_path()
    words = [f"hydra.searchpath=[{','.join(path)}]"] if path else []
    with own_hydra():
        loader = GlobalHydra.instance().config_loader()
        names = loader.get_group_options(group, config_name="config", overrides=words)
        scale = plain["scale"]["name"]
        words += [f"scale={scale}"] if scale in loader.get_group_options("scale") else []
        # Composed all at once, in packages of their own: as fast as one.
        words += [f"+{group}@choice_{number}={name}" for number, name in enumerate(names)]
        composed = hydra.compose("config", words)
    changed = OmegaConf.create(dict(plain))
    for number, name in enumerate(names):
        changed[group] = composed[f"choice_{number}"]
        yield name, changed[group]


def search_path() -> list[str]:
    """Folders of configuration files beside ours, of the command that runs."""
    return list(HydraConfig.get().searchpath) if HydraConfig.initialized() else []
