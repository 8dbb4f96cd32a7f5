"""Progress of a driver: a bar of all points with the time left, over a line per running trial.

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
    TextColumn,
    TimeRemainingColumn,
)

from rgbt.checks import without_controls
from sweeps.worker.running_trial import RunningTrial

CONSOLE = Console(stderr=True)


def bars() -> Progress:
    """Bars of rich, shown in a terminal only."""
    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(24),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        console=CONSOLE,
        transient=True,
        disable=not CONSOLE.is_terminal,
        speed_estimate_period=math.inf,  # a trial takes hours
    )


class ProgressView:
    """The progress of a driver; use as a context manager.

    `count`, called every few seconds, returns the number of points done by all drivers, and of all
    points (None: a search that ends by time).
    """

    def __init__(
        self, title: str, workers: int, count: Callable[[], tuple[int, int | None]]
    ) -> None:
        self._title, self._count = f"{title}, {workers} at a time", count
        self._ended: Counter[str] = Counter()
        self._counted_at, self._done = -math.inf, 0
        self._bars = bars()
        self._all = self._bars.add_task(title)

    def __enter__(self) -> None:
        self._bars.start()

    def __exit__(self, *error: object) -> None:
        self._bars.stop()

    def ended(self, trial: RunningTrial, how: str, reason: str) -> None:
        """Show that a trial ended: "finished", "failed" or "pruned", and why."""
        text = f"{trial.plan.point.label}  {trial.seconds:.0f} s{_score(trial)}"
        log = f"; see {trial.log}" if how == "failed" and trial.log else ""
        self.say(how, f"{text}: {reason}{log}" if reason else text)

    def say(self, how: str, text: str) -> None:
        """Print a line; in a terminal, of what is not as it should be alone."""
        self._ended[how] += 1
        is_log = self._bars.disable
        if is_log or how not in ("started", "finished"):
            clock = f"{time.strftime('%H:%M:%S')} " if is_log else ""
            line = f"{clock}{how:<8} {without_controls(text)}"
            self._bars.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def update(self, trials: Sequence[RunningTrial]) -> None:
        """Draw the bar, and the running trials below it."""
        if self._bars.disable:
            return
        if time.monotonic() - self._counted_at > 5:
            self._counted_at = time.monotonic()
            self._done, total = self._count()
            self._bars.update(self._all, total=total)
        ended = (f", {self._ended[how]} {how}" for how in ("failed", "pruned") if self._ended[how])
        done = self._done + sum(trial.done_share for trial in trials)
        labels = [without_controls(trial.plan.point.label) for trial in trials]
        lines = [
            f"\n  {label}  {each.status}{_score(each)}  {each.done_share:.0%}"
            for label, each in zip(labels, trials, strict=True)
        ]
        title = "".join([self._title, *ended, *lines])
        self._bars.update(self._all, completed=done, description=title)


def _score(trial: RunningTrial) -> str:
    return "" if math.isnan(trial.score) else f"  val mIoU {100 * trial.score:.2f}"


def duration(seconds: float) -> str:
    """Seconds as "50 s", "12 min", "3 h 20 min"."""
    minutes = round(seconds / 60)
    longer = f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
    return f"{seconds:.0f} s" if seconds < 90 else longer
