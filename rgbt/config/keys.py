"""The keys at the top of the configuration, as ``conf/config.yaml`` declares them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

from omegaconf import OmegaConf

from rgbt.checks import InputError, nearest
from rgbt.config.compose import conf_dir


@cache
def top_level() -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Nodes (mappings with `_target_`, chosen by a group or written out) and plain values."""
    plain: Any = OmegaConf.to_container(OmegaConf.load(conf_dir() / "config.yaml"))
    groups = [key for entry in plain.pop("defaults") if isinstance(entry, dict) for key in entry]
    own = {key: value for key, value in plain.items() if key != "hydra"}
    written = [key for key, value in own.items() if isinstance(value, Mapping)]
    nodes = dict.fromkeys([*(group for group in groups if " " not in group), *written])
    return tuple(nodes), tuple(key for key in own if key not in nodes)


def check_keys(keys: Iterable[Any]) -> None:
    """Refuse a key that ``conf/config.yaml`` does not declare, naming the nearest that it does."""
    nodes, values = top_level()
    for key in keys:
        if key not in (*nodes, *values):
            raise InputError(
                f"'{key!s}' is not a key of the configuration; "
                f"{nearest(str(key), (*values, *nodes))}."
            )
