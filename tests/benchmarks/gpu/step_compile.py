"""CRM training steps with `trainer.compile`, each beside the same step without it.

A step of its own: compilation may take minutes, and may break the process.
"""

from __future__ import annotations

from importlib.util import find_spec

from tests.benchmarks.gpu.step_training import (
    NETWORKS,
    Bench,
    attempt,
    headline_of,
    raise_if,
    report_failure,
)
from tests.benchmarks.gpu.task import SkippedError, Task

CASES = (
    *("swin_s bf16 default", "swin_s fp32 default", "swin_t bf16 default", "swin_b bf16 default"),
    *("swin_s bf16 max-autotune", "swin_s tf32 default"),
)


def measure(task: Task) -> None:
    """Pairs of rows, with and without compilation, as far as time allows."""
    if task.device == "cuda" and find_spec("triton") is None:
        raise SkippedError("it needs the package triton, which torch.compile uses on a GPU.")
    bench = Bench.of(task)
    rates: dict[str, float] = {}
    failed = 0
    cases = ["swin_t fp32 default"] if task.smoke else list(CASES)
    for case in task.as_time_allows(cases, first=15.0):
        name, precision, mode = case.split()
        network = next(each for each in NETWORKS if each.endswith(name))
        try:
            pair = {way: attempt(bench, network, precision, compile=way) for way in ("none", mode)}
        except Exception as error:
            report_failure(task, case, error)
            failed += 1
            continue
        if all(pair.values()):
            before, after = (pair[each]["images per second"] for each in ("none", mode))
            rates[f"{pair[mode]['network']} {precision} {mode}"] = after / before
            task.headline(headline_of(rates).replace("images per second", "times faster"))
    raise_if(failed)
