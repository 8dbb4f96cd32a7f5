"""Configurations put together once for many tests: composing takes longer than most of them."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cache

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from rgbt.config.compose import compose
from rgbt.config.schema import check
from sweeps.table.table import Row, Table


def composed(words: Sequence[str]) -> DictConfig:
    """As Hydra composes it; files are put together once, values are set in a copy of that."""
    values = [word for word in words if _sets_a_value(word)]
    config = copy.deepcopy(_of_files(tuple(word for word in words if word not in values)))
    for override in OverridesParser.create().parse_overrides(values):
        OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    return config


def _sets_a_value(word: str) -> bool:
    """Whether a word sets one key, so that it may as well come after all that choose files."""
    key = word.partition("=")[0]
    return "." in key and not set(key) & set("+~@/")


@cache
def _of_files(words: tuple[str, ...]) -> DictConfig:
    return compose(words)


@cache
def checked(words: tuple[str, ...]) -> DictConfig:
    """Composed and checked, to be read alone."""
    config = composed(words)
    check(config)
    return config


def row_config(table: Table, row: Row, scale: str = "demo") -> DictConfig:
    """The checked configuration of a row, to be read alone."""
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return checked((*table.overrides(row, scale), f"scale={scale}", *rooted))
