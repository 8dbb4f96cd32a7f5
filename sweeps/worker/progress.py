"""Progress of a driver: a bar of all points with the time left, and one for each running trial.

Where stderr is no terminal (a log file of a cluster), a line per trial that begins or ends.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
)

from rgbt.checks import without_controls
from sweeps.worker.running_trial import RunningTrial

CONSOLE = Console(stderr=True)


def bars() -> Progress:
    """Bars of rich, shown in a terminal only."""
    return Progress(
        *(TextColumn("{task.description}", markup=False), BarColumn(24), MofNCompleteColumn()),
        TimeRemainingColumn(),
        console=CONSOLE,
        transient=True,
        disable=not CONSOLE.is_terminal,
        speed_estimate_period=math.inf,  # a trial takes hours
    )


class ProgressView:
    """The progress of a driver; use as a context manager.

    Args:
        title: e.g. the table.
        workers: processes at a time.
        count: returns the number of points done by all drivers, and of all points (None: a search
            that ends by time); called every few seconds.
    """

    def __init__(
        self, title: str, workers: int, count: Callable[[], tuple[int, int | None]]
    ) -> None:
        self._title, self._count = f"{title}, {workers} at a time", count
        self._ended: Counter[str] = Counter()
        self._counted_at, self._done = -math.inf, 0
        self._bars = bars()
        self._all = self._bars.add_task(title)
        self._tasks: dict[int, TaskID] = {}

    def __enter__(self) -> None:
        self._bars.start()

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def began(self, trial: RunningTrial) -> None:
        """Show that a trial begins."""
        if self._bars.disable:
            self._say(f"started  {trial.plan.point.label}")

    def ended(self, trial: RunningTrial, how: str, reason: str) -> None:
        """Show that a trial ended: "finished", "failed" or "pruned", and why."""
        self._ended[how] += 1
        because = f": {reason}" if reason else ""
        log = f"; see {trial.log}" if how == "failed" and trial.log else ""
        if how != "finished" or self._bars.disable:
            text = f"{how:<8} {trial.plan.point.label}  {trial.seconds:.0f} s{_score(trial)}"
            self._say(text + because + log)

    def rejected(self, label: str, reason: str) -> None:
        """Show that the configuration of a point is wrong."""
        self._ended["failed"] += 1
        self._say(f"failed   {label}: {reason}")

    def update(self, trials: Sequence[RunningTrial]) -> None:
        """Draw the running trials."""
        if self._bars.disable:
            return
        if time.monotonic() - self._counted_at > 5:
            self._counted_at = time.monotonic()
            self._done, total = self._count()
            self._bars.update(self._all, total=total)
        ended = (f", {n} {how}" for how, n in self._ended.items() if how != "finished")
        done = self._done + sum(trial.done_share for trial in trials)
        self._bars.update(self._all, completed=done, description="".join([self._title, *ended]))
        for number in set(self._tasks) - {trial.number for trial in trials}:
            self._bars.remove_task(self._tasks.pop(number))
        for trial in trials:
            if trial.number not in self._tasks:
                self._tasks[trial.number] = self._bars.add_task("", total=100)
            label = without_controls(trial.plan.point.label)
            text, task = f"  {label}  {trial.status}{_score(trial)}", self._tasks[trial.number]
            self._bars.update(task, completed=100 * trial.done_share, description=text)

    def _say(self, text: str) -> None:
        clock = f"{time.strftime('%H:%M:%S')} " if self._bars.disable else ""
        line = clock + without_controls(text)
        self._bars.console.print(line, markup=False, highlight=False, soft_wrap=True)


def _score(trial: RunningTrial) -> str:
    return "" if math.isnan(trial.score) else f"  val mIoU {100 * trial.score:.2f}"


def duration(seconds: float) -> str:
    """Seconds as "50 s", "12 min", "3 h 20 min"."""
    minutes = round(seconds / 60)
    longer = f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{seconds:.0f} s" if seconds < 90 else longer
