"""Whole runs of tiny networks at demo scale: seconds, alone and eight at once on one device."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

from tests.benchmarks.gpu.device import checked
from tests.benchmarks.gpu.task import Task

EXPERIMENT = "grbm"
AT_ONCE = 8
WHOLE, SHORT = 240.0, 60
"""Seconds from which whole runs are trained, and the steps of shorter ones."""


def measure(task: Task) -> None:
    """One row for a run alone, one for all runs at once."""
    checked(task.device)
    more = _shortened(task)
    alone = _runs(task, 1, 0, more)
    task.row(runs=1, **alone)
    number = 2 if task.smoke else AT_ONCE
    together = _runs(task, number, 1, more)
    task.row(runs=number, **together)
    task.note(f"+experiment={EXPERIMENT} scale=demo {' '.join(more)}")
    ratio = number * alone["seconds"] / together["seconds"]
    task.headline(
        f"{alone['seconds']:.3g} s alone, {together['seconds']:.3g} s for {number} at once "
        f"({ratio:.3g} times the runs per second)"
    )


def _shortened(task: Task) -> list[str]:
    """Overrides that make a run short enough; none where there is time for whole runs."""
    if task.smoke:
        return ["+debug=smoke"]
    if task.left() > WHOLE:
        return []
    length = [f"trainer.max_steps={SHORT}", f"trainer.eval_every={SHORT}"]
    return [*length, "scale.few_scenes=true"]


def _runs(task: Task, number: int, first_seed: int, more: list[str]) -> dict[str, float]:
    """Seconds until all of some runs have ended, and the share before the first run trains."""
    runs_dir = task.folder / f"runs_{number}_{first_seed}"
    began = time.monotonic()
    logs = [task.folder / f"run_{first_seed + index}.log" for index in range(number)]
    started = []
    for index, log in enumerate(logs):
        with log.open("wb") as output:
            words = [*_words(task, runs_dir, first_seed + index), *more]
            started.append(subprocess.Popen(words, stdout=output, stderr=subprocess.STDOUT))
    for process, log in zip(started, logs, strict=True):
        if process.wait(max(1.0, task.left() - 1.0)):
            print(log.read_text())
            raise RuntimeError(f"a run ended with exit code {process.returncode}; its log is above")
    seconds = time.monotonic() - began
    inside = [_seconds_inside(path) for path in runs_dir.glob("*/result.json")]
    if len(inside) != number:
        raise RuntimeError(f"{number} runs ended, but {len(inside)} have a result")
    start_up = seconds - max(inside)
    return {
        "seconds": seconds,
        "seconds per run": seconds / number,
        "start-up, s": start_up,
        "start-up share": start_up / seconds,
        "CPU cores": len(os.sched_getaffinity(0)),
    }


def _words(task: Task, runs_dir: Path, seed: int) -> list[str]:
    words = [sys.executable, "-m", "rgbt.run", f"+experiment={EXPERIMENT}", "tracking=none"]
    return [*words, f"seed={seed}", f"runs_dir={runs_dir}", f"trainer.accelerator={task.device}"]


def _seconds_inside(result: Path) -> float:
    """Seconds from the start of the training of a run to its result."""
    return float(json.loads(result.read_text())["seconds_of_last_process"])
