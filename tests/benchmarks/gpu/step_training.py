"""CRM training steps at the paper's batch, through the project's own set-up and loop.

Images lie on the device; the input path is measured by `step_loading`. Swin-S, the published
network, comes first.
"""

from __future__ import annotations

import gc
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from statistics import median
from typing import Any

import torch

from rgbt.assembly.training_setup import TrainingSetup
from rgbt.evaluation.profile import count_flops
from rgbt.runtime.resources import is_out_of_memory
from tests.benchmarks.gpu.device import (
    arithmetic,
    checked,
    matmul_rate,
    peak_mib,
    reset_peak,
)
from tests.benchmarks.gpu.project import (
    OnDevice,
    Training,
    batch_on,
    crm_words,
    loss_of,
    part_of,
    setup_of,
    write_mfnet,
)
from tests.benchmarks.gpu.task import Task, sentence_of

BATCH = 14
"""Images of a step (CRM, Sec. IV-A)."""

WARM, STEPS = 2, 6
"""Steps before those that count, and those."""

PRECISIONS = {"fp32": "32-true", "tf32": "32-true", "bf16": "bf16-mixed"}
NETWORKS = ("mask2former_swin_s", "mask2former_swin_t", "mask2former_swin_b")


@dataclass
class Bench:
    """What the configurations share.

    Attributes:
        task: of this step.
        device: that is measured.
        root: a data set of images in the layout of MFNet.
        rates: operations per second of a matrix product, by precision.
        flops: operations of one training step of one image, by network.
    """

    task: Task
    device: torch.device
    root: Path
    rates: dict[str, float]
    flops: dict[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, task: Task) -> Bench:
        """Write the images, start the device and measure its products."""
        device = checked(task.device)
        count = 2 if task.smoke else 2 * BATCH
        hw = (48, 64) if task.smoke else (240, 320)
        root = write_mfnet(task.folder / "images", count, hw)
        names = ("fp32",) if task.smoke else tuple(PRECISIONS)
        rates = {name: matmul_rate(device, name, small=task.smoke) for name in names}
        return cls(task, device, root, rates)


def measure(task: Task) -> None:
    """One row for each network, precision and checkpointing, as far as time allows."""
    bench = Bench.of(task)
    best: dict[str, float] = {}
    failed = 0
    cases = [
        f"{network} {precision} {checkpointing}"
        for checkpointing in ("false", "true")
        for network in (NETWORKS[:1] if task.smoke else NETWORKS)
        for precision in (("fp32",) if task.smoke else PRECISIONS)
    ]
    for case in task.as_time_allows(cases, first=10.0):
        network, precision, checkpointing = case.split()
        try:
            row = attempt(bench, network, precision, activation_checkpointing=checkpointing)
        except Exception as error:
            report_failure(task, case, error)
            failed += 1
            continue
        if row and checkpointing == "false":
            best[f"{row['network']} {precision}"] = row["images per second"]
            task.headline(headline_of(best))
    raise_if(failed)


def report_failure(task: Task, case: str, error: Exception) -> None:
    """A note of a configuration that failed; its traceback is in the log."""
    traceback.print_exception(error)
    task.note(f"{case} failed: {sentence_of(error)}")


def raise_if(failed: int) -> None:
    """Fail the step if a configuration has failed."""
    if failed:
        raise AssertionError(f"{failed} configurations failed; the notes name them")


def headline_of(rates: dict[str, float]) -> str:
    """Images per second of some configurations."""
    return "images per second: " + ", ".join(f"{name} {rate:.3g}" for name, rate in rates.items())


def attempt(bench: Bench, network: str, precision: str, **trainer: str) -> dict[str, Any]:
    """One row; with half the batch where memory runs out; {} where not even one image fits."""
    size = 2 if bench.task.smoke else BATCH
    shown = "tiny" if bench.task.smoke else _short(network)
    names = {"network": shown, "precision": precision, **trainer}
    while size:
        row = None
        with arithmetic(precision):
            try:
                row = _steps(bench, network, precision, size, trainer)
            except (RuntimeError, MemoryError) as error:
                if not is_out_of_memory(error):
                    raise
                print(f"{names}, batch {size}: {error}")
        # Outside of the handler: the error holds the frames, and these hold the tensors.
        if row is not None:
            bench.task.row(**names, **row)
            return names | row
        reset_peak(bench.device)
        bench.task.note(f"{' '.join(names.values())}: batch {size} does not fit into memory.")
        size //= 2
    return {}


def _steps(
    bench: Bench, network: str, precision: str, size: int, trainer: dict[str, str]
) -> dict[str, Any]:
    """Train for some steps and describe them."""
    device, smoke = bench.device, bench.task.smoke
    reset_peak(device)
    words = crm_words(network, size, bench.root, smoke=smoke)
    words += [f"trainer.precision={PRECISIONS[precision]}"]
    words += [f"trainer.{name}={value}" for name, value in trainer.items()]
    began = time.perf_counter()
    setup = setup_of(words, device)
    height, width = setup.session.transform.crop_hw
    batch = batch_on(device, size, (height, width))
    warm, steps = (1, 1) if smoke else (WARM, STEPS)
    training = Training(setup, bench.task.folder)
    watched = training.run(batches_of(batch), warm + steps)
    first = watched.times[1] - began
    each = median(watched.seconds(warm))
    row = {
        "batch": size,
        "images per second": size / each,
        "ms per step": 1e3 * each,
        "peak memory, MiB": peak_mib(device),
        "seconds to first step": first,
        "loss": training.recorded[-1]["loss"],
    }
    if trainer.get("compile", "none") == "none":
        with arithmetic("fp32"):
            bench.flops.setdefault(network, flops_of(setup, part_of(batch, 1)))
    if network in bench.flops and precision in bench.rates:
        done = bench.flops[network] * size / each
        row["TFLOP per image"] = bench.flops[network] / 1e12
        row["share of the product's rate"] = done / bench.rates[precision]
    del setup, training, watched, batch
    gc.collect()
    return row


def batches_of(batch: Any) -> Iterator[OnDevice]:
    """The same batch again and again."""
    return repeat(OnDevice(batch))


def flops_of(setup: TrainingSetup, image: Any) -> float:
    """Operations of forward and backward pass of one image, as `rgbt profile` counts them."""
    setup.model.train()
    setup.model.zero_grad(set_to_none=True)
    total = float(count_flops(lambda: loss_of(setup, image)))
    setup.model.zero_grad(set_to_none=True)
    return total


def _short(network: str) -> str:
    return network.removeprefix("mask2former_")
