"""The progress bar of a command: what was done, speed and remaining time in one line.

A training that becomes much slower says so.
"""

from __future__ import annotations

import os
from collections import deque
from statistics import fmean, median

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

from rgbt.cores import usable_cores
from rgbt.terminal import warn

# A training is slow when its last steps take so many times as long as its first ones.
SLOWER, NUM_FIRST, NUM_LAST = 10, 100, 10

# Progress goes to stderr; stdout is for results.
CONSOLE = Console(stderr=True)


def progress() -> Progress:
    """A progress display with columns for count, time left and a note (task field `note`)."""
    # Drawing ten times a second takes 2 % of a core. In a file only the last state is written.
    return Progress(
        SpinnerColumn(),
        TextColumn("{task.description:<10}", markup=False),
        BarColumn(bar_width=30),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.fields[note]}", markup=False),
        console=CONSOLE,
        refresh_per_second=4,
        auto_refresh=CONSOLE.is_terminal,
    )


class Pace:
    """The time of the steps of a training; warns once where they become much slower.

    Medians are compared, so that one slow step is no reason.
    """

    def __init__(self, threads: int) -> None:
        self._threads, self._has_warned = threads, False
        self._first: list[float] = []
        self._last: deque[tuple[float, float]] = deque(maxlen=NUM_LAST)

    def add(self, seconds: float, waited: float) -> None:
        """Note a step: its time, and the part of it in which it waited for its images."""
        if self._has_warned:
            return
        if len(self._first) < NUM_FIRST:
            self._first.append(seconds)
        self._last.append((seconds, waited))
        usual, now = median(self._first), median(seconds for seconds, _ in self._last)
        if len(self._first) < 2 * NUM_LAST or now < SLOWER * usual:
            return
        self._has_warned = True
        share = fmean(waited / seconds for seconds, waited in self._last)
        warn(
            f"a step takes {now:.3g} s now, {now / usual:.0f} times as long as before "
            f"({share:.0%} of it waiting for images). The load of this machine is "
            f"{os.getloadavg()[0]:.1f} on {usable_cores()} cores, and trainer.threads="
            f"{self._threads}: see whether other programs need its cores, or its disk."
        )
