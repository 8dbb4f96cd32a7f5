"""What a person sees while points are worked off: one line per worker, and how long it will take.

Where stderr is no terminal (a log file of a cluster), a line per point that begins or ends.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from statistics import median
from types import TracebackType

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from rgbt.tracking.fit import SHORTEST, shortened
from sweeps.worker.running_trial import RunningTrial

CONSOLE = Console(stderr=True)
LABEL_WIDTH = 52
BESIDE = 68
"""Characters of a line beside the label: bar, share, status and score."""

SHORT_S = 5.0
"""A point that took less was not trained, its result was known."""


class ProgressView:
    """A live view of a driver; use as a context manager.

    Args:
        title: what is worked on, e.g. the table.
        total: points in all; None for a search that ends by time.
        workers: how many work at a time.
        count: asked now and then for the number of points that are done, also by other drivers.
    """

    def __init__(
        self, title: str, total: int | None, workers: int, count: Callable[[], int]
    ) -> None:
        self._title = title
        self._total = total
        self._workers = workers
        self._count = count
        self._ended: Counter[str] = Counter()
        self._seconds: list[float] = []
        self._done = count()
        self._counted = time.monotonic()
        self._live = Live(console=CONSOLE, refresh_per_second=4) if CONSOLE.is_terminal else None

    def __enter__(self) -> ProgressView:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def began(self, work: RunningTrial) -> None:
        """A point is worked on."""
        if self._live is None:
            self._say(f"begins   {work.plan.point.label}")

    def ended(self, work: RunningTrial, how: str, reason: str) -> None:
        """A point is done with: "finished", "failed" or "pruned", and why."""
        self._ended[how] += 1
        self._done += 1
        if how == "finished" and work.seconds > SHORT_S:
            self._seconds.append(work.seconds)
        score = "" if math.isnan(work.score) else f"  val mIoU {100 * work.score:.2f}"
        because = f": {reason}" if reason else ""
        text = f"{how:<8} {work.plan.point.label}  {work.seconds:.0f} s{score}{because}"
        if how != "finished" or self._live is None:
            self._say(text)

    def refused(self, label: str, reason: str) -> None:
        """A point could not be begun."""
        self._ended["failed"] += 1
        self._say(f"failed   {label}: {reason}")

    def update(self, works: Sequence[RunningTrial]) -> None:
        """Draw the state of the workers."""
        if self._live is None:
            return
        now = time.monotonic()
        if now - self._counted > 5:
            self._counted, self._done = now, self._count()
        rows = Table.grid(padding=(0, 2))
        room = max(SHORTEST, min(LABEL_WIDTH, CONSOLE.width - BESIDE))
        labels = shortened([work.plan.point.label for work in works], [room] * len(works))
        for work, label in zip(works, labels, strict=True):
            score = "" if math.isnan(work.score) else f"val mIoU {100 * work.score:.2f}"
            bar = ProgressBar(total=1.0, completed=work.done_share, width=24)
            rows.add_row(
                "  ", Text(label), bar, f"{100 * work.done_share:3.0f} %", Text(work.status), score
            )
        self._live.update(Group(Text(self._headline(works)), rows))

    def _headline(self, works: Sequence[RunningTrial]) -> str:
        of = "" if self._total is None else f" of {self._total}"
        failed = f", {self._ended['failed']} failed" if self._ended["failed"] else ""
        pruned = f", {self._ended['pruned']} pruned" if self._ended["pruned"] else ""
        left = self._left(works)
        return f"{self._title}: {self._done}{of} done{failed}{pruned}, {len(works)} running{left}"

    def _left(self, works: Sequence[RunningTrial]) -> str:
        """Time left, as far as the points finished so far tell."""
        if self._total is None:
            return ""
        shares = [work.done_share for work in works]
        each = median(self._seconds) if self._seconds else _projected(works)
        if each is None:
            return ""
        points = max(0, self._total - self._done - len(works)) + sum(1 - share for share in shares)
        return f", about {duration(points * each / self._workers)} left"

    def _say(self, text: str) -> None:
        if self._live is not None:
            self._live.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            CONSOLE.print(f"{time.strftime('%H:%M:%S')} {text}", markup=False, soft_wrap=True)


def _projected(works: Sequence[RunningTrial]) -> float | None:
    """Seconds of a point, from how far the running ones have come."""
    shares = [(work.seconds, work.done_share) for work in works if work.done_share > 0.05]
    return median(seconds / share for seconds, share in shares) if shares else None


def duration(seconds: float) -> str:
    """Seconds as "50 s", "12 min", "3 h 20 min"."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60:02d} min"
