"""Where the host waits for the GPU in a training step: line, number and time per step.

PyTorch reports every operation that synchronises, and the profiler adds up the time. On a CPU
there is none.
"""

from __future__ import annotations

import time
import traceback
import warnings
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch.overrides import TorchFunctionMode

import rgbt
from rgbt.engine.trainer import WAIT_SHARE
from rgbt.runtime.resources import is_out_of_memory
from tests.benchmarks.gpu.device import checked, reset_peak
from tests.benchmarks.gpu.project import Training, crm_words, setup_of, write_mfnet
from tests.benchmarks.gpu.task import Task

WARM, STEPS = 3, 4
LEAST = 5e-5
"""Seconds from which a call counts as waiting."""

PACKAGE = Path(rgbt.__file__).parent


def measure(task: Task) -> None:
    """One row for each line that waits."""
    device = checked(task.device)
    if device.type == "cuda":
        _measure_on_gpu(task, device)
    else:
        task.headline("the waits of a step need a GPU")


def line_of_ours() -> str:
    """File, line and function of the last frame in our code."""
    for frame in reversed(traceback.extract_stack()):
        path = Path(frame.filename)
        if path.is_relative_to(PACKAGE):
            return f"{path.relative_to(PACKAGE.parent)}:{frame.lineno} {frame.name}"
    return "elsewhere"


def _measure_on_gpu(task: Task, device: torch.device) -> None:
    root = task.data or write_mfnet(task.folder / "images", 4 if task.smoke else 28)
    for size in (2,) if task.smoke else (14, 7, 2):
        reset_peak(device)
        try:
            training, batches = _warm(task, root, size, device)
            break
        except (RuntimeError, MemoryError) as error:
            if not is_out_of_memory(error) or size == 2:
                raise
            task.note(f"batch {size} does not fit into memory.")
    with _synchronisations() as seen, _Clock() as clock:
        watched = training.run(batches, STEPS, synchronise=False)
    step_ms = 1e3 * (watched.times[-1] - watched.times[0]) / STEPS
    lines = sorted(seen, key=lambda line: -clock.seconds[line])
    for line in lines:
        ms = 1e3 * clock.seconds[line] / STEPS
        task.row(line=line, **{"per step": seen[line] / STEPS, "ms per step": ms})
    task.note(f"Swin-S, batch {size}, bf16-mixed; {step_ms:.0f} ms.")
    waiting = [each[WAIT_SHARE] for each in training.recorded[WARM:]]
    task.note(f"wait_share of these steps: {max(waiting):.2g} at most.")
    number = sum(seen.values()) / STEPS
    total = 1e3 * sum(clock.seconds[line] for line in seen) / STEPS
    task.headline(f"{number:.3g} waits and {total:.0f} ms of waiting per step of {step_ms:.0f} ms")
    _profile(task, training, batches)


def _warm(task: Task, root: Any, size: int, device: torch.device) -> tuple[Training, Iterator[Any]]:
    """A training after its first steps, and the batches that follow."""
    words = crm_words("mask2former_swin_s", size, root, smoke=task.smoke)
    words += [f"data.cache={task.folder / 'cache'}", "data.num_workers=0"]
    setup = setup_of([*words, "trainer.precision=bf16-mixed"], device)
    batches = setup.batches(range(WARM + 3 * STEPS))
    training = Training(setup, task.folder)
    training.run(batches, WARM)
    return training, batches


@contextmanager
def _synchronisations() -> Iterator[Counter[str]]:
    """Lines of our code at which PyTorch reports a synchronisation."""
    seen: Counter[str] = Counter()

    def note(message: Warning | str, *others: Any, **more: Any) -> None:
        if "synchroniz" in str(message):
            seen[line_of_ours()] += 1

    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.showwarning = note
        torch.cuda.set_sync_debug_mode("warn")
        try:
            yield seen
        finally:
            torch.cuda.set_sync_debug_mode("default")


class _Clock(TorchFunctionMode):
    """Seconds of long calls by line: nearly all of a call that waits is waiting."""

    def __init__(self) -> None:
        super().__init__()
        self.seconds: Counter[str] = Counter()

    def __torch_function__(
        self,
        func: Any,
        types: Sequence[type],
        args: tuple[Any, ...] = (),
        kwargs: Mapping[str, Any] | None = None,
    ) -> Any:
        began = time.perf_counter()
        result = func(*args, **(kwargs or {}))
        took = time.perf_counter() - began
        if took > LEAST:
            self.seconds[line_of_ours()] += took
        return result


def _profile(task: Task, training: Training, batches: Iterator[Any]) -> None:
    """Calls of CUDA in which the host may wait, as the profiler counts them."""
    kinds = [torch.profiler.ProfilerActivity.CPU, torch.profiler.ProfilerActivity.CUDA]
    try:
        with torch.profiler.profile(activities=kinds) as profiler:
            training.run(batches, STEPS, synchronise=False)
    except RuntimeError as error:
        task.note(f"the profiler cannot be used here ({str(error).splitlines()[0]}).")
        return
    for event in profiler.key_averages():
        if "Synchronize" in event.key or event.key.startswith(("cudaMemcpy", "cuMemcpy")):
            ms = event.cpu_time_total / 1e3 / STEPS
            values = {"per step": event.count / STEPS, "ms per step": ms}
            task.row(line=f"profiler: {event.key}", **values)
