"""Configurations of the rows of tables, read only: rows share their common parts."""

from __future__ import annotations

from functools import cache

from omegaconf import DictConfig

from rgbt.config.compose import compose
from rgbt.runs.specify import specify
from sweeps.table.table import Row, Table


def row_config(table: Table, row: Row, scale: str = "demo") -> DictConfig:
    """The checked configuration of a row."""
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return checked((*table.overrides(row, scale), f"scale={scale}", *rooted))


@cache
def checked(overrides: tuple[str, ...]) -> DictConfig:
    """The configuration of a run that was checked."""
    config = compose(overrides)
    specify(config)
    return config
