"""Sizes of the networks of the rows at scale=paper, which the papers print, without any run."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.overrides import composing
from sweeps.plan.request import TableRequest
from sweeps.score.cells import NO_VALUE, CellId, TableCell

SCALE = "paper"  # scale of all networks
NOT_NETWORK = ("model.weights=", "tracking", "runs_dir=")  # overrides that begin so


def network_sizes(request: TableRequest) -> dict[CellId, TableCell]:
    """Return the cells with millions of parameters of the rows' networks.

    Of a network that cannot be built, the cell has the reason.
    """
    names = {column.name for column in request.table.columns if column.efficiency == "parameters"}
    if not names:
        return {}
    at_paper = replace(request, scale=SCALE, pretrained={})
    cells: dict[CellId, TableCell] = {}
    for row in request.table.runnable_rows:
        words = at_paper.overrides(row.label, 0)[:-1]
        kept = tuple(word for word in words if not word.lstrip("+~").startswith(NOT_NETWORK))
        try:
            cell = TableCell(million_parameters(kept), math.nan, 0)
        except InputError as error:
            cell = TableCell(math.nan, math.nan, 0, str(error), NO_VALUE)
        for column in request.table.columns_of(row):
            if column.name in names:
                cells[row.label, column.name] = cell
    return cells


@cache
def million_parameters(overrides: tuple[str, ...]) -> float:
    """Count the millions of parameters of the network that overrides of a run describe.

    It is built on torch's device "meta". Discriminators are not counted. InputError: as refused.
    """
    import torch

    with composing(overrides), torch.device("meta"):
        network = build(compose(overrides).model)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
