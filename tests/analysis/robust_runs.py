"""Output of `rgbt robustness` for runs, with known scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rgbt.files.plain_files import write_json
from rgbt.metrics.counts import Counts
from rgbt.runs.folder import Description, RunFolder
from tests.analysis.counts import counts_of, result_of

Scores = dict[tuple[str, str, str, float], int]
SCORES: Scores = {
    ("clean", "clean", "", 0.0): 80,
    ("rgb_removed", "RGB removed (zeroed)", "", 1.0): 20,
    ("features-thermal", "thermal alone (features)", "", 1.0): 30,
    ("noise", "noise, RGB and thermal", "grey levels (std)", 8.0): 60,
    ("noise", "noise, RGB and thermal", "grey levels (std)", 16.0): 40,
}
"""(row, title, unit, severity) -> mIoU in percent."""

PIXELS = 100_000


def right(percent: int, images: int = 12) -> Counts:
    """Counts whose mIoU is `percent`, of two classes with as many pixels.

    With a of N right in both classes, IoU = a / (2 N - a), so a = 2 N IoU / (1 + IoU).
    """
    a = round(2 * PIXELS * percent / (100 + percent))
    return counts_of(np.array([[[[a, PIXELS - a], [PIXELS - a, a]]]] * images))


def write_levels(folder: Path, scores: Scores) -> Path:
    """The files of one training."""
    folder.mkdir(parents=True, exist_ok=True)
    for (row, title, unit, severity), percent in scores.items():
        mark = row if row == "clean" or row.startswith("features") else f"{row}-{severity:g}"
        right(percent).save(folder / f"{mark}.npz")
        made = {"row": row, "title": title, "unit": unit, "severity": severity}
        write_json(folder / f"{mark}.json", made)
    return folder


def write_run(runs: Path, key: str, group: str, seed: int, scores: Scores) -> Path:
    """A finished run that was measured."""
    run = RunFolder(runs / key)
    run.write_config("name: x\n")
    run.describe(Description(key, {"rgbt.group": group, "rgbt.seed": str(seed)}, {}))
    counts = right(80)
    counts.counts[..., 0, :] += np.array([-seed, seed])  # other predictions of the same labels
    counts.save(run.path / "counts_test.npz")
    run.finish(result_of(key, counts))
    write_levels(run.path / "evaluations" / "robustness" / "test", scores)
    return run.path


def less(by: int) -> Scores:
    """The scores of `SCORES`, lower by so many points."""
    return {level: percent - by for level, percent in SCORES.items()}
