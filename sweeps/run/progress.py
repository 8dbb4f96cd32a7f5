"""Progress of a driver: a bar of all points with the time left, over a line per running point.

Where stderr is no terminal (a log file of a cluster), a line per point that starts or ends, and the
state of all once a minute.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Sequence

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeRemainingColumn,
)

from rgbt.checks import without_controls
from sweeps.point import Outcome
from sweeps.run.running_point import RunningPoint

CONSOLE = Console(stderr=True)
STATUS_S = 60.0  # seconds between two states in a log
LINES = 20  # of running points, at most
ENDS = ("finished", "failed", "pruned")


def bars() -> Progress:
    """Return bars of rich, shown in a terminal only."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(24),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=CONSOLE,
        transient=True,
        disable=not CONSOLE.is_terminal,
        speed_estimate_period=math.inf,  # a point takes hours
    )


class ProgressView:
    """Shows the progress of a driver; use as a context manager."""

    def __init__(self, title: str) -> None:
        self._title, self._bars = title, bars()
        self._all = self._bars.add_task("starting", total=None)
        self._status_at = time.monotonic() + STATUS_S

    def __enter__(self) -> None:
        self._bars.start()

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def begin(self, where: str) -> None:
        """Say what is run and `where`; jobs may take long to start."""
        self.say("sweep", f"{self._title}, {where}")

    def ended(self, point: RunningPoint, outcome: Outcome) -> None:
        """Show how a point ended, and why."""
        text = f"{point.plan.point.label}  {duration(point.seconds)}{_score(point)}"
        if outcome.reason:
            text += f": {outcome.reason}"
        is_named = str(point.log) in outcome.reason
        if outcome.reason and outcome.state == "failed" and not is_named:
            text += f"; see {point.log}"
        self.say(outcome.state, text)

    def say(self, how: str, text: str) -> None:
        """Print a line; in a terminal, of what is not as it should be alone."""
        is_log = self._bars.disable
        if is_log or how not in ("queued", "started", "finished"):
            clock = f"{time.strftime('%H:%M:%S')} " if is_log else ""
            line = f"{clock}{how:<8} {without_controls(text)}"
            self._bars.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def update(self, running: Sequence[RunningPoint], counts: Counter[str]) -> None:
        """Draw the bar and the running points; in a log, print them when they are due.

        `counts` are points by state; without "waiting": a search that ends by time.
        """
        total = counts.total() if "waiting" in counts else None
        done = sum(counts[word] for word in ENDS)
        queued = sum(not point.is_started for point in running)
        shown = {**counts, "running": len(running) - queued, "queued": queued}
        words = ", ".join(f"{number} {word}" for word, number in shown.items() if number)
        lines = [_line(point) for point in running if point.is_started][:LINES]
        shares = sum(point.step / point.steps for point in running)
        description = "\n  ".join([words, *lines])
        self._bars.update(self._all, completed=done + shares, total=total, description=description)
        if self._bars.disable and time.monotonic() > self._status_at:
            self._status_at = time.monotonic() + STATUS_S
            left = self._bars.tasks[0].time_remaining
            self.say("state", words if left is None else f"{words}; {duration(left)} left")
            for line in lines:
                self.say("", f"  {line}")


def _line(point: RunningPoint) -> str:
    """Return the line of a running point: label, steps, score, time left."""
    label = without_controls(point.plan.point.label)
    left = point.seconds_left
    ends = "" if math.isnan(left) else f"  {duration(left)} left"
    return f"{label}  step {point.step} of {point.steps}{_score(point)}{ends}"


def _score(point: RunningPoint) -> str:
    return "" if math.isnan(point.score) else f"  val mIoU {100 * point.score:.2f}"


def duration(seconds: float) -> str:
    """Write seconds as "50 s", "12 min" or "3 h 20 min"."""
    minutes = round(seconds / 60)
    if seconds < 90:
        return f"{seconds:.0f} s"
    if minutes < 90:
        return f"{minutes} min"
    return f"{minutes // 60} h {minutes % 60:02d} min"
