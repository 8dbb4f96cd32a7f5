"""Output of `rgbt robustness` for runs, with known scores."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import CLEAN
from rgbt.runs.folder import Description, RunFolder
from tests.analysis.counts import counts_of, result_of
from tests.measured import differing, store

Scores = dict[tuple[str, str, str, float], int]
SCORES: Scores = {
    ("clean", "clean", "", 0.0): 80,
    ("rgb_removed", "RGB removed (zeroed)", "", 1.0): 20,
    ("thermal", "thermal alone", "", 0.0): 30,
    ("noise", "noise, RGB and thermal", "grey levels (std)", 8.0): 60,
    ("noise", "noise, RGB and thermal", "grey levels (std)", 16.0): 40,
}
"""(condition, title, unit, severity) -> mIoU in percent."""

PIXELS = 100_000


def right(percent: int, images: int = 12) -> Counts:
    """Counts whose mIoU is `percent`, of two classes with as many pixels.

    With a of N right in both classes, IoU = a / (2 N - a), so a = 2 N IoU / (1 + IoU).
    """
    a = round(2 * PIXELS * percent / (100 + percent))
    return counts_of(np.array([[[[a, PIXELS - a], [PIXELS - a, a]]]] * images))


def measured(scores: Scores) -> Iterator[tuple[Counts, dict[str, Any]]]:
    """The counts of each condition, and in which fields it differs from clean images."""
    for (condition, title, unit, severity), percent in scores.items():
        if condition == CLEAN:
            yield right(percent), {}
        elif condition == "thermal":
            yield right(percent), {"view": condition}
        else:
            shown = {"corruption": condition, "title": title, "unit": unit}
            yield right(percent), {"severity": severity, **shown}


def write_levels(folder: Path, scores: Scores) -> Path:
    """What rgbt robustness writes of one training to another folder than that of its run."""
    folder.mkdir(parents=True, exist_ok=True)
    for counts, fields in measured(scores):
        found = differing(counts, run="0123456789ab", **fields)
        found.save(folder / found.measurement.file_name)
    return folder


def write_run(runs: Path, key: str, group: str, seed: int, scores: Scores) -> Path:
    """A finished run that was measured."""
    run = RunFolder(runs / key)
    run.write_config("name: x\n")
    run.describe(Description(key, {"rgbt.group": group, "rgbt.seed": str(seed)}, {}))
    for counts, fields in measured(scores):
        store(run.path, counts, **fields)
        if not fields:
            run.finish(result_of(key, counts))
    return run.path


def less(by: int) -> Scores:
    """The scores of `SCORES`, lower by so many points."""
    return {level: percent - by for level, percent in SCORES.items()}
