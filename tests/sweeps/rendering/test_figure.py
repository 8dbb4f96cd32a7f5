from __future__ import annotations

from sweeps.rendering.figure import (
    figure_of,
    main_columns,
)
from sweeps.table.cells import score
from sweeps.table.table import Column, Factor, Row
from tests.sweeps.tabled import counts_of, outcome, table

MIOU = Column(name="mIoU", metric="mIoU")
VAR = Column(name="Var", metric="Var", best="lowest")


def factor_table(shift: float = 0.0):
    rows = [Row(label="base", experiment="crm", values={"mIoU": 60.0 + shift})]
    rows += [
        Row(label=f"x={x}", experiment="crm", x=x, values={"mIoU": 60.0 + x + shift, "Var": 9.0})
        for x in (4.0, 1.0, 2.0)
    ]
    made = table(tuple(rows), (MIOU, VAR), factor=Factor(name="sigma", axis="log"))
    runs = {(row.label, seed): outcome("k", counts_of()) for row in rows for seed in (0, 1)}
    return score("own/factor", made, runs, scale="demo")


def test_factor_against_both_metrics_in_order_of_x() -> None:
    figure = figure_of(factor_table(shift=8.0))
    upper, lower = figure.axes[0], figure.axes[1]
    assert (upper.get_ylabel(), lower.get_ylabel()) == ("mIoU", "Var")
    assert lower.get_xlabel() == "sigma"
    assert lower.get_xscale() == "log"
    printed = next(line for line in upper.lines if line.get_markerfacecolor() == "none")
    assert list(printed.get_xdata()) == [1.0, 2.0, 4.0]
    assert list(printed.get_ydata()) == [69.0, 70.0, 72.0]
    levels = [line.get_ydata()[0] for line in upper.lines if line.get_label().startswith("base")]
    assert levels[1:] == [68.0]


def test_main_columns_are_headlines_of_day_and_night() -> None:
    metrics = ("mAcc", "mIoU", "night/Var", "class/car", "TC", "dawn/mIoU")
    columns = tuple(Column(name=metric, metric=metric) for metric in metrics)
    rows = (Row(label="a", values=dict.fromkeys(metrics, 3.0)),)
    scored = score("t", table(rows, columns), {}, scale="demo")
    assert [column.name for column in main_columns(scored)] == ["mIoU", "night/Var", "TC"]
