"""Configurations composed once for many tests, because composing takes longer than most tests."""

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
def specified(words: tuple[str, ...]) -> RunSpec:
    """The specification of the run that `words` request."""
    return specify(composed(words), words)


def row_spec(table: Table, row: Row, scale: str = "demo") -> RunSpec:
    """The specification of the run of a row."""
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return specified((*table.overrides(row, scale), f"scale={scale}", *rooted))
