"""The input path: cache and augmentation, alone and in front of a CRM step."""

from __future__ import annotations

import os
import time
from pathlib import Path
from statistics import median

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.engine.trainer import WAIT_SHARE
from rgbt.runtime.resources import is_out_of_memory
from tests.benchmarks.gpu.device import arithmetic, checked, reset_peak, wait
from tests.benchmarks.gpu.project import Training, crm_words, setup_of, write_mfnet
from tests.benchmarks.gpu.task import Task

BATCH = 14
WORKERS = ("0", "4", "8")
NETWORK = "mask2former_swin_t"
"""The fastest published one: it shows waiting first."""


def measure(task: Task) -> None:
    """One row for each number of loader processes."""
    device = checked(task.device)
    root = task.data or write_mfnet(task.folder / "images", 8 if task.smoke else 8 * BATCH)
    size = 2 if task.smoke else BATCH
    workers = ["0", "2"] if task.smoke else list(WORKERS)
    shares = {}
    for number in task.as_time_allows(workers, first=8.0):
        reset_peak(device)
        setup = setup_of(_words(task, root, size, number), device)
        began = time.perf_counter()
        for name in setup.names["train"]:
            setup.session.dataset.read(name)  # writes the cache
        decoding = time.perf_counter() - began
        row = {
            "num_workers": int(number),
            "images per second, loader": _loader_alone(setup, size, 4 if task.smoke else 40),
        }
        row |= _in_training(task, setup, size)
        task.row(**row, **{"decoding, s": decoding})
        shares[number] = row.get(WAIT_SHARE, float("nan"))
    cores = len(os.sched_getaffinity(0))
    where = "synthetic images" if task.data is None else str(task.data)
    task.note(f"Batch {size}, {where}, cache, {cores} CPU cores.")
    task.headline("wait_share: " + ", ".join(f"{n} workers {s:.2g}" for n, s in shares.items()))


def _words(task: Task, root: Path, size: int, workers: str) -> list[str]:
    words = crm_words(NETWORK, size, root, smoke=task.smoke)
    if task.smoke:
        words += ["dataset=mfnet", f"dataset.root={root}"]
    cache = task.folder / "cache"
    words += [f"data.num_workers={workers}", f"data.cache={cache}"]
    return [*words, "trainer.precision=bf16-mixed"]


def _loader_alone(setup: TrainingSetup, size: int, steps: int) -> float:
    """Images per second that are read, augmented and moved."""
    device = setup.session.device
    batches = setup.batches(range(steps + 2))
    for _ in range(2):  # processes start, memory is allocated
        next(batches).to(device)
    wait(device)
    began = time.perf_counter()
    for batch in batches:
        batch.to(device)
    wait(device)
    return steps * size / (time.perf_counter() - began)


def _in_training(task: Task, setup: TrainingSetup, size: int) -> dict[str, float]:
    """Steps with real loading; nothing but the step waits for the device."""
    warm, steps = (1, 2) if task.smoke else (3, 10)
    training = Training(setup, task.folder)
    batches = setup.batches(range(warm + steps))
    try:
        with arithmetic("tf32"):
            watched = training.run(batches, warm + steps, synchronise=False)
    except (RuntimeError, MemoryError) as error:
        if not is_out_of_memory(error):
            raise
        task.note(f"the step with batch {size} does not fit into memory.")
        return {}
    return {
        "images per second, step": size / median(watched.seconds(warm)),
        WAIT_SHARE: median(each[WAIT_SHARE] for each in training.recorded[warm:]),
    }
