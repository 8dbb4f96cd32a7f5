"""Columns of parameters: the network of every row built without memory and counted."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.component import build
from rgbt.config.compose import compose
from sweeps.table.cell_points import Wanted
from sweeps.table.cells import NO_VALUE, Cell, Place

SCALE = "paper"
"""What is counted, whatever scale the rows are run at: papers print the sizes of their networks."""


def parameter_cells(wanted: Wanted) -> dict[Place, Cell]:
    """The cells of all columns of parameters, of the rows that the project can run.

    Args:
        wanted: the table; its scale, seeds and files of weights make no difference.

    Returns:
        millions of parameters by place; a network that cannot be built says why.
    """
    table = wanted.table
    columns = [column for column in table.columns if column.parameters]
    at_paper = replace(wanted, scale=SCALE, weights={})
    counted: dict[tuple[str, ...], Cell] = {}
    cells: dict[Place, Cell] = {}
    for row in filter(table.runnable, table.rows if columns else ()):
        *overrides, _ = at_paper.overrides(row.label, 0)
        network = tuple(overrides)
        if network not in counted:
            counted[network] = _cell(network)
        shown = (column.name for column in table.columns_of(row) if column in columns)
        cells |= {(row.label, name): counted[network] for name in shown}
    return cells


def _cell(overrides: Sequence[str]) -> Cell:
    try:
        return Cell(million_parameters(overrides), math.nan, 0)
    except InputError as error:
        return Cell(math.nan, math.nan, 0, str(error), NO_VALUE)


def million_parameters(overrides: Sequence[str]) -> float:
    """Millions of parameters of the network that overrides of `python -m rgbt.run` describe.

    Only the node `model` is built, on torch's device "meta": no data set is read, its `root` may be
    missing, and no memory is taken. Critics belong to the scheme and are not counted; parameters
    that do not learn are.

    Args:
        overrides: with ``scale=paper`` for a published size.

    Raises:
        InputError: overrides that Hydra or the network's constructor refuses.
    """
    import torch

    with composing(overrides):
        node = compose(overrides).model
        with torch.device("meta"):
            network = build(node)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
