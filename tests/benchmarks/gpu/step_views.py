"""Virtual views of a batch, forward and with gradient, against a loop of OpenCV."""

from __future__ import annotations

import torch

from tests.benchmarks.bench_virtual_views import BATCH, CLASSES, HW, Work, check
from tests.benchmarks.gpu.device import checked, seconds_of
from tests.benchmarks.gpu.task import Task

REPEATS = 10


def measure(task: Task) -> None:
    """One row for each way; the loop includes copies from and to the device, as in the release."""
    device = checked(task.device)
    work = Work(device.type)
    if not task.smoke:
        check(work)
    ways = {
        "OpenCV loop, no gradient": work.opencv,
        "ours, no gradient": lambda: work.ours(gradient=False),
        "ours with gradient": work.ours,
        "ours as released, with gradient": lambda: work.ours("corners", "twice"),
        "logits by grid_sample alone, with gradient": work.plain,
    }
    if task.smoke:
        ways = dict(list(ways.items())[:3])
    loop = 0.0
    for name, call in ways.items():
        seconds = seconds_of(call, device, 1 if task.smoke else REPEATS)
        loop = loop or seconds
        task.row(
            way=name, **{"ms per sample": 1e3 * seconds / BATCH, "times faster": loop / seconds}
        )
        if name == "ours with gradient":
            task.headline(f"{loop / seconds:.3g} times faster than the loop, with gradient")
    task.note(f"{BATCH} x {HW[0]}x{HW[1]}, {CLASSES} classes, PyTorch {torch.__version__}.")
