"""Progress of a driver: one line per worker, and the time left.

Where stderr is no terminal (a log file of a cluster), a line per trial that begins or ends.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from statistics import median

from rich.console import Console, Group
from rich.live import Live
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn
from rich.progress_bar import ProgressBar
from rich.table import Column, Table
from rich.text import Text

from rgbt.checks import without_controls
from rgbt.terminal import plain_text
from sweeps.worker.running_trial import RunningTrial

CONSOLE = Console(stderr=True)
SAY_S = 10.0
"""Seconds between two lines about planning where stderr is no terminal."""

SHORT_S = 5.0
"""A trial that took less was not trained: its runs were finished before."""


@dataclass
class ProgressView:
    """The progress of a driver; use as a context manager.

    Attributes:
        title: e.g. the table.
        total: number of points; None for a search that ends by time.
        workers: processes at a time.
        count: returns the number of points done by all drivers; called every few seconds.
    """

    title: str
    total: int | None
    workers: int
    count: Callable[[], int]

    def __post_init__(self) -> None:
        self._ended: Counter[str] = Counter()
        self._seconds: list[float] = []
        self._done = self.count()
        self._counted = time.monotonic()
        self._planning = ""
        self._live = Live(console=CONSOLE, refresh_per_second=4) if CONSOLE.is_terminal else None

    def __enter__(self) -> ProgressView:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(self, *error: object) -> None:
        if self._live is not None:
            self._live.stop()

    def began(self, trial: RunningTrial) -> None:
        """Show that a trial begins."""
        if self._live is None:
            self._say(f"started  {trial.plan.point.label}")

    def ended(self, trial: RunningTrial, how: str, reason: str) -> None:
        """Show that a trial ended: "finished", "failed" or "pruned", and why."""
        self._ended[how] += 1
        self._done += 1
        if how == "finished" and trial.seconds > SHORT_S:
            self._seconds.append(trial.seconds)
        score = "" if math.isnan(trial.score) else f"  val mIoU {100 * trial.score:.2f}"
        because = f": {reason}" if reason else ""
        text = f"{how:<8} {trial.plan.point.label}  {trial.seconds:.0f} s{score}{because}"
        if how != "finished" or self._live is None:
            self._say(text)

    def added(self, labels: Sequence[str]) -> None:
        """Show that points were added."""
        self.total = None if self.total is None else self.total + len(labels)
        self._say(f"added    {', '.join(labels)}")

    def planned(self, num_runs: int, num_left: int) -> None:
        """Show that so many different points are planned, and so many points are not yet."""
        self.total = num_runs + num_left
        self._planning = f", {num_left} points to plan" if num_left else ""

    def rejected(self, label: str, reason: str) -> None:
        """Show that the configuration of a point is wrong."""
        self._ended["failed"] += 1
        self._say(f"failed   {label}: {reason}")

    def update(self, trials: Sequence[RunningTrial]) -> None:
        """Draw the running trials."""
        if self._live is None:
            return
        now = time.monotonic()
        if now - self._counted > 5:
            self._counted, self._done = now, self.count()
        rows = Table.grid(Column(), Column(overflow="fold"), padding=(0, 2))
        for trial in trials:
            score = "" if math.isnan(trial.score) else f"val mIoU {100 * trial.score:.2f}"
            bar = ProgressBar(total=1.0, completed=trial.done_share, width=24)
            share = f"{100 * trial.done_share:3.0f} %"
            label = plain_text(trial.plan.point.label)
            rows.add_row("  ", label, bar, share, Text(trial.status), score)
        self._live.update(Group(plain_text(self._headline(trials)), rows))

    def _headline(self, trials: Sequence[RunningTrial]) -> str:
        of = "" if self.total is None else f" of {self.total}"
        ends = ((how, self._ended[how]) for how in ("failed", "pruned"))
        ended = "".join(f", {count} {how}" for how, count in ends if count)
        running = f"{len(trials)} running{self._left(trials)}"
        return f"{self.title}: {self._done}{of} done{ended}, {running}{self._planning}"

    def _left(self, trials: Sequence[RunningTrial]) -> str:
        """Estimated time left, from the trials finished so far."""
        if self.total is None:
            return ""
        begun = [trial for trial in trials if trial.done_share > 0.05]
        known = self._seconds or [trial.seconds / trial.done_share for trial in begun]
        if not known:
            return ""
        waiting = max(0, self.total - self._done - len(trials))
        points = waiting + sum(1 - trial.done_share for trial in trials)
        return f", about {duration(points * median(known) / self.workers)} left"

    def _say(self, text: str) -> None:
        text = without_controls(text)
        if self._live is not None:
            self._live.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            CONSOLE.print(f"{time.strftime('%H:%M:%S')} {text}", markup=False, soft_wrap=True)


@contextmanager
def planning_progress(title: str, num_points: int) -> Iterator[Callable[[int], None]]:
    """Show how many of some points are planned, until the context ends.

    Yields:
        a function that takes the number of planned points; called often.
    """
    if CONSOLE.is_terminal:
        columns = (TextColumn("{task.description}"), BarColumn(bar_width=24), MofNCompleteColumn())
        with Progress(*columns, console=CONSOLE, transient=True) as display:
            task = display.add_task(f"{title}: planning", total=num_points)
            yield lambda count: display.update(task, completed=count)
        return
    last = time.monotonic()

    def say(count: int) -> None:
        nonlocal last
        if time.monotonic() - last > SAY_S:
            last = time.monotonic()
            text = f"{time.strftime('%H:%M:%S')} planned  {count} of {num_points} points"
            CONSOLE.print(text, markup=False, highlight=False, soft_wrap=True)

    yield say


def duration(seconds: float) -> str:
    """Seconds as "50 s", "12 min", "3 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
