"""Progress of a driver: lines in a log, bars in a terminal."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console

from sweeps.point import Outcome, Point
from sweeps.run import progress
from sweeps.run.executors import place_of
from sweeps.run.progress import ProgressView, duration

Make = Callable[[bool], io.StringIO]
LABEL = "files=[/data/a] [red]not a colour[/red]"
RUNNING: Any = SimpleNamespace(
    plan=SimpleNamespace(point=Point(LABEL, ())),
    log="runs/.logs/k.log",
    is_started=True,
    **{"score": 0.4567, "step": 50, "steps": 100, "seconds": 100.0, "seconds_left": 1500.0},
)
FINISHED = Outcome(RUNNING.plan.point, "finished")
FAILED = Outcome(RUNNING.plan.point, "failed", "a bad day")
QUEUED: Any = SimpleNamespace(**{**vars(RUNNING), "is_started": False, "step": 0})
COUNTS = Counter(finished=1, failed=1, running=2, waiting=4)
LINE = f"  {LABEL}  step 50 of 100  val mIoU 45.67  25 min left"


@pytest.fixture
def console(monkeypatch: pytest.MonkeyPatch) -> Make:
    def make(is_terminal: bool) -> io.StringIO:
        text = io.StringIO()
        made = Console(file=text, force_terminal=is_terminal, width=160, color_system=None)
        monkeypatch.setattr(progress, "CONSOLE", made)
        return text

    return make


def test_a_log_has_lines_of_begin_and_end_and_of_the_state(
    console: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    text, minutes = console(False), [0.0]
    clock = SimpleNamespace(monotonic=lambda: 60 * minutes[0], strftime=lambda _: "12:00:00")
    monkeypatch.setattr(progress, "time", clock)
    view = ProgressView("table")
    with view:
        view.begin("as tasks of Ray, 2 at a time")
        view.say("started", LABEL)
        for now in (0.5, 1.1, 1.5):
            minutes[0] = now
            view.update([RUNNING, QUEUED], COUNTS)
        view.ended(RUNNING, FINISHED)
        view.ended(RUNNING, FAILED)
        view.ended(RUNNING, replace(FAILED, reason="lost; see runs/.logs/k.log"))
    assert [line[9:].rstrip() for line in text.getvalue().splitlines()] == [
        "sweep    table, as tasks of Ray, 2 at a time",
        f"started  {LABEL}",
        "state    1 finished, 1 failed, 1 running, 4 waiting, 1 queued",
        f"         {LINE}",
        f"finished {LABEL}  2 min  val mIoU 45.67",
        f"failed   {LABEL}  2 min  val mIoU 45.67: a bad day; see runs/.logs/k.log",
        f"failed   {LABEL}  2 min  val mIoU 45.67: lost; see runs/.logs/k.log",
    ]


def test_a_terminal_has_bars_and_lines_of_failures(console: Make) -> None:
    text = console(True)
    view = ProgressView("table")
    with view:
        view.begin("on this machine, 1 at a time")
        assert view._bars.tasks[0].total is None, (
            "nothing is known before the first job has started"
        )
        for word in ("queued", "started"):
            view.say(word, LABEL)
        view.ended(RUNNING, FINISHED)
        view.ended(RUNNING, FAILED)
        view.update([RUNNING, QUEUED], COUNTS)
        probe = Console(file=io.StringIO(), width=160)
        probe.print(view._bars.get_renderable())
        seen = probe.file.getvalue()  # type: ignore[attr-defined]
        parts = ("1 finished, 1 failed, 1 running, 4 waiting, 1 queued", "/8", LINE.strip())
        assert all(part in seen for part in parts), seen
    assert "sweep    table, on this machine, 1 at a time" in text.getvalue()
    assert f"failed   {LABEL}  2 min  val mIoU 45.67: a bad day" in text.getvalue()
    assert not any(f"{word:<8} {LABEL}" in text.getvalue() for word in ("started", "finished"))


def test_durations_are_read_by_people() -> None:
    shown = {0: "0 s", 89.4: "89 s", 90: "2 min", 3600: "60 min", 12060: "3 h 21 min"}
    assert {seconds: duration(seconds) for seconds in shown} == shown


@pytest.mark.parametrize(
    ("launcher", "workers", "place"),
    [
        ("basic", None, "on this machine, 1 at a time"),
        ("ray", 8, "as tasks of Ray, 8 at a time"),
        ("submitit_slurm", None, "as jobs of SLURM, all of them at a time"),
        ("submitit_local", None, "as jobs of submitit on this machine, 1 at a time"),
    ],
)
def test_the_place_of_the_jobs_is_named(launcher: str, workers: int | None, place: str) -> None:
    settings: Any = SimpleNamespace(launcher=launcher, workers=workers)
    assert place_of(settings) == place
