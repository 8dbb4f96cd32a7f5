"""The lines of a training in a log: what was done, speed and remaining time.

A training that becomes much slower says so.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from datetime import timedelta
from statistics import fmean, median

from rgbt.checks import without_controls
from rgbt.cores import usable_cores
from rgbt.terminal import CONSOLE, PAUSE_S, warn

# A training is slow when its last steps take so many times as long as its first ones.
SLOWER, NUM_FIRST, NUM_LAST = 10, 100, 10

# Lines of a training that are written without a pause; later ones come every `PAUSE_S` seconds.
NUM_AT_ONCE = 10


def training_log(total: int) -> Callable[[int, Mapping[str, float]], None]:
    """Return a function that writes the values of a step as a line, unless a bar shows them.

    The first `NUM_AT_ONCE` lines and that of the last step, `total`, are always written, the others
    at most every `PAUSE_S` seconds.
    """
    count, written_at = 0, -math.inf

    def write(step: int, values: Mapping[str, float]) -> None:
        nonlocal count, written_at
        now = time.monotonic()
        if count >= NUM_AT_ONCE and step < total and now - written_at < PAUSE_S:
            return
        count, written_at = count + 1, now
        _write(step, total, _in_words(values))

    return write


def write_evaluation(
    step: int, total: int, split: str, score: float, best: tuple[float, int]
) -> None:
    """Write the mIoU of a split, and the best one so far with its step, unless a bar is shown."""
    best_score, best_step = best
    of_best = f", best {100 * best_score:.2f} % at step {best_step}" if best_score >= 0 else ""
    _write(step, total, f"{split} mIoU {100 * score:.2f} %{of_best}")


def _write(step: int, total: int, text: str) -> None:
    if not CONSOLE.is_terminal:
        sys.stderr.write(without_controls(f"{step:>{len(str(total))}}/{total}  {text}") + "\n")


def _in_words(values: Mapping[str, float]) -> str:
    """Columns of one width, then the parts of the loss: "left 4:12:03  20.3 img/s ..."."""
    left = timedelta(seconds=round(values["seconds_left"]))
    gib = values["peak_memory_mib"] / 2**10
    rate = max(value for name, value in values.items() if name.startswith("lr/"))
    parts = []
    for name, value in values.items():
        if name.startswith("loss/"):
            parts.append(f"{name.removeprefix('loss/')} {value:<4.2g}")
    return (
        f"left {left!s:>7}  {values['images_per_s']:4.1f} img/s  {gib:4.1f} GiB  lr {rate:.1e}  "
        f"loss {values['loss']:<5.4g} {' '.join(parts)}".rstrip()
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
