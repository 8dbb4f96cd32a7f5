"""Sizes of the networks of the rows at scale=paper, which the papers print, without any run."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.overrides import composing
from sweeps.table.cells import NO_VALUE, CellId, TableCell
from sweeps.table.request import TableRequest

SCALE = "paper"  # scale of all networks
NOT_NETWORK = ("model.weights=", "tracking", "runs_dir=")  # overrides that begin so


def network_sizes(request: TableRequest) -> dict[CellId, TableCell]:
    """Millions of parameters of each row; the reason where a network cannot be built."""
    named = [each.name for each in request.table.columns if each.efficiency == "parameters"]
    at_paper = replace(request, scale=SCALE, pretrained={})
    cells: dict[CellId, TableCell] = {}
    for row in request.table.runnable_rows if named else ():
        words = at_paper.overrides(row.label, 0)[:-1]
        kept = tuple(word for word in words if not word.lstrip("+~").startswith(NOT_NETWORK))
        try:
            cell = TableCell(million_parameters(kept), math.nan, 0)
        except InputError as error:
            cell = TableCell(math.nan, math.nan, 0, str(error), NO_VALUE)
        columns = {each.name for each in request.table.columns_of(row)}
        cells |= {(row.label, name): cell for name in named if name in columns}
    return cells


@cache
def million_parameters(overrides: tuple[str, ...]) -> float:
    """Millions of parameters of the network that overrides of `python -m rgbt.run` describe.

    It is built on torch's device "meta". Discriminators are not counted. InputError: as refused.
    """
    import torch

    with composing(overrides), torch.device("meta"):
        network = build(compose(overrides).model)
    count: int = sum(parameter.numel() for parameter in network.parameters())
    return count / 1e6
