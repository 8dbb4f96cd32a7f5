"""Configurations of the rows of tables, read only: rows share their common parts."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cache

from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import DictConfig, OmegaConf

from rgbt.config.compose import compose
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify
from sweeps.table.table import Row, Table


def row_config(table: Table, row: Row, scale: str = "demo") -> DictConfig:
    """The checked configuration of a row."""
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return checked((*table.overrides(row, scale), f"scale={scale}", *rooted))


@cache
def checked(overrides: Sequence[str]) -> DictConfig:
    """The configuration of `specified`."""
    config = _with_values(overrides)
    specify(config)
    return config


@cache
def specified(overrides: Sequence[str]) -> RunSpec:
    """As Hydra composes it: files are put together once, values are set in a copy of that."""
    return specify(_with_values(overrides))


def _with_values(overrides: Sequence[str]) -> DictConfig:
    values = tuple(word for word in overrides if _sets_a_value(word))
    config = copy.deepcopy(_composed(tuple(word for word in overrides if word not in values)))
    parser = OverridesParser.create()
    for override in parser.parse_overrides(list(values)):
        OmegaConf.update(config, override.key_or_group, override.value(), merge=True)
    return config


def _sets_a_value(word: str) -> bool:
    """Whether a word sets one key, as the order of such words among the others is free."""
    key = word.partition("=")[0]
    return "." in key and not set(key) & set("+~@/")


@cache
def _composed(overrides: Sequence[str]) -> DictConfig:
    return compose(overrides)
