"""Progress of a driver: lines in a log, a live view in a terminal."""

from __future__ import annotations

import io
import math
from collections.abc import Callable
from typing import Any

import pytest
from rich.console import Console

from sweeps.worker import progress
from sweeps.worker.progress import ProgressView, duration


class Shown:
    """Stands for a work."""

    def __init__(
        self,
        label: str = "Ny/4 seed=1",
        *,
        score: float = math.nan,
        share: float = 0.5,
        seconds: float = 100.0,
    ) -> None:
        self.score = score
        self.done_share = share
        self.seconds = seconds
        self.status = "training"
        self.number, self.log = 0, "runs/.logs/k.log"
        self.plan = type("Plan", (), {"point": type("Point", (), {"label": label})})


@pytest.fixture
def console(monkeypatch: pytest.MonkeyPatch) -> Callable[[bool], io.StringIO]:
    def make(is_terminal: bool) -> io.StringIO:
        text = io.StringIO()
        made = Console(file=text, force_terminal=is_terminal, width=160, color_system=None)
        monkeypatch.setattr(progress, "CONSOLE", made)
        return text

    return make


Make = Callable[[bool], io.StringIO]


def test_progress_in_log_prints_begin_and_end(console: Make) -> None:
    text = console(False)
    view = ProgressView("table", 3, 1, lambda: 0)
    with view:
        one: Any = Shown(score=0.4567)
        view.began(one)
        view.update([one])
        view.ended(one, "finished", "")
        view.ended(one, "failed", "ValueError: [red]not a colour[/red] [1,2]")
        view.rejected("p", "x does not fit.")
    lines = [line[9:] for line in text.getvalue().splitlines()]
    assert lines == [
        "started  Ny/4 seed=1",
        "finished Ny/4 seed=1  100 s  val mIoU 45.67",
        "failed   Ny/4 seed=1  100 s  val mIoU 45.67: ValueError: [red]not a colour[/red] [1,2]; "
        "see runs/.logs/k.log",
        "failed   p: x does not fit.",
    ]


def test_progress_in_terminal_draws_bars_and_prints_failures(console: Make) -> None:
    text = console(True)
    view = ProgressView("table", lambda: 4, 2, lambda: 1)
    with view:
        one: Any = Shown("fresh=[decoder] files=[/data/a]", score=0.5)
        view.began(one)
        view.ended(one, "finished", "")
        view.ended(one, "failed", "a bad day")
        view.update([one])
        probe = Console(file=io.StringIO(), width=160)
        probe.print(view._bars.get_renderable())
        seen = probe.file.getvalue()  # type: ignore[attr-defined]
        for part in (
            "table, 2 at a time, 1 failed",
            "1/4",
            "fresh=[decoder] files=[/data/a]",
            "50/100",
        ):
            assert part in seen
        assert "training  val mIoU 50.00" in seen
        view.update([])
        assert len(view._bars.tasks) == 1
    assert "failed   fresh=[decoder] files=[/data/a]  100 s  val mIoU 50.00: a bad day" in (
        text.getvalue()
    )
    assert "finished fresh" not in text.getvalue()


@pytest.mark.parametrize(
    ("seconds", "text"),
    [(0, "0 s"), (89.4, "89 s"), (90, "2 min"), (3600, "60 min"), (5400, "1 h 30 min"),
     (12060, "3 h 21 min")],
)  # fmt: skip
def test_durations_are_read_by_people(seconds: float, text: str) -> None:
    assert duration(seconds) == text
