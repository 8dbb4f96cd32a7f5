"""Columns of parameters: the network of every row is built without memory and counted."""

from __future__ import annotations

import math
from dataclasses import replace

from rgbt.checks import InputError
from sweeps.run_specs import million_parameters
from sweeps.table.cells import NO_VALUE, CellId, TableCell
from sweeps.table.request import TableRequest

SCALE = "paper"
"""Scale of all counts, whatever scale the rows are run at: papers print the sizes of networks."""


def parameter_cells(request: TableRequest) -> dict[CellId, TableCell]:
    """The cells of all columns of parameters, of the rows that the project can run.

    Args:
        request: the table; its scale, seeds and files of weights make no difference.

    Returns:
        millions of parameters; of a network that cannot be built, the reason.
    """
    table = request.table
    columns = [column for column in table.columns if column.parameters]
    at_paper = replace(request, scale=SCALE, weights={})
    counted: dict[tuple[str, ...], TableCell] = {}
    cells: dict[CellId, TableCell] = {}
    for row in table.runnable_rows if columns else ():
        network = at_paper.overrides(row.label, 0)[:-1]
        if network not in counted:
            counted[network] = _cell(network)
        names = (column.name for column in table.columns_of(row) if column in columns)
        cells |= {(row.label, name): counted[network] for name in names}
    return cells


def _cell(network: tuple[str, ...]) -> TableCell:
    try:
        return TableCell(million_parameters(network), math.nan, 0)
    except InputError as error:
        return TableCell(math.nan, math.nan, 0, str(error), NO_VALUE)
