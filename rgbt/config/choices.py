"""Which files of a group could be chosen instead, each as it would be in a given configuration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from omegaconf import DictConfig, OmegaConf

from rgbt.config.compose import available, compose


def choices(plain: Mapping[str, Any], group: str) -> Iterator[tuple[str, DictConfig]]:
    """The files of ``conf/<group>/`` and of `hydra.searchpath`: name, and the node that each makes.

    Args:
        plain: the configuration that interpolations of the files refer to, as resolved values.
        group: key of the node, which is the name of its folder.
    """
    names = available(group)
    scale = plain["scale"]["name"]
    words = [f"scale={scale}"] if scale in available("scale") else []
    # Composed all at once, in packages of their own: as fast as one.
    words += [f"+{group}@choice_{number}={name}" for number, name in enumerate(names)]
    composed = compose(words)
    changed = OmegaConf.create(dict(plain))
    for number, name in enumerate(names):
        changed[group] = composed[f"choice_{number}"]
        yield name, changed[group]
