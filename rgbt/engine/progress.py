"""The progress bar of a command: what was done, speed and remaining time in one line.

A training that becomes much slower says so.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
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
    """Make a progress display with columns for count, time left and a note (task field `note`)."""
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


def watch_pace(threads: int) -> Callable[[float, float], None]:
    """Return a function that notes every step of a training, and warns once if they become slow.

    Its arguments are the seconds of a step, and those in which the step waited for its images.
    Medians are compared, so that one slow step is no reason. `threads` is for the message.
    """
    first: list[float] = []
    last: deque[tuple[float, float]] = deque(maxlen=NUM_LAST)
    has_warned = False

    def note(seconds: float, waited: float) -> None:
        nonlocal has_warned
        if has_warned:
            return
        if len(first) < NUM_FIRST:
            first.append(seconds)
        last.append((seconds, waited))
        usual, now = median(first), median(of_step for of_step, _ in last)
        if len(first) < 2 * NUM_LAST or now < SLOWER * usual:
            return
        has_warned = True
        share = fmean(wait / of_step for of_step, wait in last)
        warn(
            f"a step takes {now:.3g} s now, {now / usual:.0f} times as long as before "
            f"({share:.0%} of it waiting for images). The load of this machine is "
            f"{os.getloadavg()[0]:.1f} on {usable_cores()} cores, and trainer.threads="
            f"{threads}: see whether other programs need its cores, or its disk."
        )

    return note
