"""The preview of a table: states of its runs and their evaluations."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from sweeps.point import Outcome
from sweeps.rendering.preview import cells_grid, summary
from sweeps.table.request import TableRequest
from sweeps.table.table import Column, Row
from tests.sweeps.tabled import table

FRAMES = (
    Column(name="TC", metric="TC", frames="released"),
    Column(name="TC aligned", metric="TC", frames="aligned", printed=False),
    Column(name="next", metric="TC", frames="next", printed=False),
)
RGB = Column(name="rgb", metric="mIoU", modality="rgb")
ROWS = (Row(label="a", experiment="crm"), Row(label="b", experiment="grbm"))


def request_of(columns: tuple[Column, ...]) -> tuple[TableRequest, list[Outcome]]:
    wanted = TableRequest("own/t", table(ROWS, columns), "demo", (0,))
    return wanted, [Outcome(point, "waiting") for point in wanted.points()]


class Trained:
    """Stands for a finished run of ten seconds."""

    key = "k"
    other_code = None

    def __init__(self, folder: Any) -> None:
        self.folder = folder


def test_preview_names_worlds_in_one_command() -> None:
    wanted, outcomes = request_of((RGB,))
    worlds = {"N-": ("dataset.rgb_noise=0.0",), "N+": ("dataset.rgb_noise=0.1",)}
    rows = tuple(replace(row, tested_in=worlds) for row in wanted.table.rows)
    wanted = replace(wanted, table=replace(wanted.table, rows=rows))
    assert summary(wanted, outcomes, 2)[-1] == (
        "Evaluations of every run that still lacks them: rgbt evaluate modality=rgb "
        "'regions=as trained'; rgbt evaluate in 2 worlds (N-, N+)."
    )


def test_trained_runs_without_evaluations_are_reported(tmp_path: Any) -> None:
    (tmp_path / "result.json").write_text('{"seconds_of_last_process": 10}')
    wanted, (first, second) = request_of(FRAMES)
    found: Any = (Trained(tmp_path),)
    outcomes = [replace(first, results=found, keys=("k",)), second]
    assert summary(wanted, outcomes, 1)[1:] == [
        "Time left with workers=1: 10 s.",
        "Evaluations of every run that still lacks them: rgbt consistency frames=virtual; "
        "rgbt consistency frames=next.",
        "Already trained: 1; the time left excludes their evaluations.",
    ]
    rows = cells_grid(wanted, outcomes).rows
    assert [row[1:] for row in rows] == [
        ("waiting", "10", "k", "trained, not evaluated for all columns"),
        ("waiting", "-", "-", ""),
    ]
