"""The figure of a table over a factor: values by hand."""

from __future__ import annotations

from sweeps.rendering.figure import figure_of
from sweeps.table.cells import score
from sweeps.table.table import Column, Factor, Row
from tests.sweeps.tabled import counts_of, outcome, table


def test_factor_is_drawn_in_order_of_x() -> None:
    rows = [
        Row(label=f"x={x}", experiment="crm", x=x, values={"mIoU": 60.0 + x}) for x in (4.0, 1.0)
    ]
    columns = (Column(name="mIoU", metric="mIoU"), Column(name="Var", metric="Var"))
    made = table(tuple(rows), columns, factor=Factor(name="sigma", axis="log"))
    runs = {(row.label, seed): outcome("k", counts_of()) for row in rows for seed in (0, 1)}
    upper, lower = figure_of(score("own/factor", made, runs, scale="demo")).axes[:2]
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("mIoU", "Var")
    assert (lower.get_xlabel(), lower.get_xscale()) == ("sigma", "log")
    printed = next(line for line in upper.lines if line.get_markerfacecolor() == "none")
    assert [list(printed.get_xdata()), list(printed.get_ydata())] == [[1.0, 4.0], [61.0, 64.0]]
