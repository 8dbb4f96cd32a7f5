"""A table of the papers at demo scale, by the command that a user gives, as far as time allows."""

from __future__ import annotations

import os
import sys
import time

from tests.benchmarks.gpu.device import checked
from tests.benchmarks.gpu.processes import run
from tests.benchmarks.gpu.task import Task

TABLE = "crm/table3a"
WHOLE, SHORT = 400.0, 60
"""Seconds from which whole runs are trained, and the steps of shorter ones."""

END = 4.0
"""Seconds before the limit at which the table is interrupted."""


def measure(task: Task) -> None:
    """Runs that ended within the time, and the table as far as it is filled."""
    checked(task.device)
    runs_dir = task.folder / "runs"
    workers = 2 if task.smoke else min(8, max(2, len(os.sched_getaffinity(0)) // 2))
    words = [sys.executable, "-m", "sweeps.reproduce", f"table={TABLE}", "scale=demo"]
    words += [f"workers={workers}", f"runs_dir={runs_dir}", "tracking=none"]
    words += [f"trainer.accelerator={task.device}"]
    steps = 2 if task.smoke else 0 if task.left() > WHOLE else SHORT
    if steps:
        words += [f"trainer.max_steps={steps}", f"trainer.eval_every={steps}"]
        words.append(f"scale.few_scenes={str(task.smoke).lower()}")
        task.note(f"Each run has {steps} steps, so the scores are not those of the table.")
    log = task.folder / "table.log"
    began = time.monotonic()
    code = run(words, max(1.0, task.left() - END), log)
    seconds = time.monotonic() - began
    print(log.read_text())
    ended = len(list(runs_dir.glob("*/result.json")))
    state = "complete" if code == 0 else "interrupted" if code is None else f"exit code {code}"
    task.row(
        table=TABLE,
        state=state,
        workers=workers,
        **{"runs that ended": ended, "seconds": seconds, "runs per minute": 60 * ended / seconds},
    )
    task.headline(f"{TABLE} {state}: {ended} runs in {seconds:.0f} s with {workers} workers")
    if code:
        last = (log.read_text().strip() or "no output").splitlines()[-1]
        raise RuntimeError(f"sweeps.reproduce ended with exit code {code}: {last}")
