"""Specifications made once for many tests, because that takes longer than most tests."""

from __future__ import annotations

from functools import cache

from rgbt.config.compose import compose
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import specify
from sweeps.plan.table import Row, Table


@cache
def specified(words: tuple[str, ...]) -> RunSpec:
    """The specification of the run that `words` request."""
    return specify(compose(words), words)


def row_spec(table: Table, row: Row, scale: str = "demo") -> RunSpec:
    """The specification of the run of a row."""
    rooted = ("dataset.root=/data",) if scale == "paper" else ()
    return specified((*table.overrides(row, scale), f"scale={scale}", *rooted))
