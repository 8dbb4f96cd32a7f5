"""Progress of a driver: lines in a log, bars in a terminal."""

from __future__ import annotations

import io
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from sweeps.point import Point
from sweeps.run import progress
from sweeps.run.progress import ProgressView, duration

Make = Callable[[bool], io.StringIO]
LABEL = "files=[/data/a] [red]not a colour[/red]"
TRIAL: Any = SimpleNamespace(
    score=0.4567,
    done_share=0.5,
    seconds=100.0,
    status="training",
    number=0,
    log="runs/.logs/k.log",
    plan=SimpleNamespace(point=Point(LABEL, ())),
)


@pytest.fixture
def console(monkeypatch: pytest.MonkeyPatch) -> Make:
    def make(is_terminal: bool) -> io.StringIO:
        text = io.StringIO()
        made = Console(file=text, force_terminal=is_terminal, width=160, color_system=None)
        monkeypatch.setattr(progress, "CONSOLE", made)
        return text

    return make


def test_progress_in_log_prints_begin_and_end(console: Make) -> None:
    text = console(False)
    view = ProgressView("table", 1, lambda: (0, 3))
    with view:
        view.say("started", TRIAL.plan.point.label)
        view.update([TRIAL])
        view.ended(TRIAL, "finished", "")
        view.ended(TRIAL, "failed", "a bad day")
        view.say("failed", "p: x does not fit.")
    assert [line[9:] for line in text.getvalue().splitlines()] == [
        f"started  {LABEL}",
        f"finished {LABEL}  100 s  val mIoU 45.67",
        f"failed   {LABEL}  100 s  val mIoU 45.67: a bad day; see runs/.logs/k.log",
        "failed   p: x does not fit.",
    ]


def test_progress_in_terminal_draws_bars_and_prints_failures(console: Make) -> None:
    text = console(True)
    view = ProgressView("table", 2, lambda: (1, 4))
    with view:
        view.say("started", TRIAL.plan.point.label)
        view.ended(TRIAL, "finished", "")
        view.ended(TRIAL, "failed", "a bad day")
        view.update([TRIAL])
        probe = Console(file=io.StringIO(), width=160)
        probe.print(view._bars.get_renderable())
        seen = probe.file.getvalue()  # type: ignore[attr-defined]
        parts = ("table, 2 at a time, 1 failed", "1/4", LABEL, "training  val mIoU 45.67  50%")
        assert all(part in seen for part in parts)
    assert f"failed   {LABEL}  100 s  val mIoU 45.67: a bad day" in text.getvalue()
    assert "finished" not in text.getvalue()


def test_durations_are_read_by_people() -> None:
    shown = {0: "0 s", 89.4: "89 s", 90: "2 min", 3600: "60 min", 12060: "3 h 21 min"}
    assert {seconds: duration(seconds) for seconds in shown} == shown
