"""One row of `tests.benchmarks.gpu_check`, in a process of its own: steps of CRM at paper size.

A row is a training in the project's own loop with images of MFNet's size. Its last line is JSON.

Run: python -m tests.benchmarks.gpu_step tf32 swin_s cuda FOLDER [CHECKOUT]
"""

from __future__ import annotations

import json
import platform
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import repeat
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np
import torch
from torch.autograd import DeviceType
from torch.profiler import ProfilerActivity, profile
from torch.utils.flop_counter import FlopCounterMode

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import WAIT_SHARE, Hooks
from rgbt.runs.provenance import code, machine
from rgbt.runs.specify import specify
from tests.benchmarks.loop import trainer_of

NEVER, KERNELS = 1_000_000, 15
STEPS = {"cuda": (3, 8), "cpu": (1, 2)}  # to warm up, and timed

# Rows and their settings; images are on the device unless a setting is of the data.
ROWS = {
    "tf32": (),
    "fp32": ("trainer.matmul_precision=highest",),
    "bf16": ("trainer.precision=bf16-mixed",),
    "bf16_decoder": ("trainer.precision=bf16-mixed", "model.pixel_decoder_fp32=false"),
    "release": (),
    "eager": ("trainer.compile=none",),
    "loader_cache": ("data.num_workers=4",),
    "loader_files": ("data.num_workers=4", "data.cache=null"),
    "recomputed": ("trainer.activation_checkpointing=true",),
    "not_fused": (),
    "compiled": ("trainer.compile=default",),
}
EXAMINED = "tf32"  # whose operations and kernels are counted


class OnDevice:
    """A batch that is on the device already."""

    def __init__(self, batch: Any) -> None:
        self.batch, self.name = batch, batch.name

    def to(self, device: torch.device) -> Any:
        """The batch."""
        return self.batch


def write_images(folder: Path, count: int, hw: tuple[int, int]) -> None:
    """A data set in MFNet's layout; smooth noise compresses about as well as photographs do."""
    rng = np.random.default_rng(0)
    names = [f"{number:05d}D" for number in range(count)]
    for part in ("images", "labels"):
        (folder / part).mkdir(parents=True)
    for name in names:
        coarse = rng.integers(0, 256, (hw[0] // 4, hw[1] // 4, 4), dtype=np.uint8)
        cells = rng.integers(0, 9, (4, 5), dtype=np.uint8)
        image = cv2.resize(coarse, hw[::-1], interpolation=cv2.INTER_LINEAR)
        label = cv2.resize(cells, hw[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / "images" / f"{name}.png"), image)
        cv2.imwrite(str(folder / "labels" / f"{name}.png"), label)
    for split, listed in (("train", names), ("val", names[:1]), ("test", names[:1])):
        (folder / f"{split}.txt").write_text("\n".join(listed) + "\n")


def set_up(row: str, network: str, device: str, root: Path) -> TrainingSetup:
    """CRM as published (batch 14), or a tiny network on a CPU."""
    words = ["+experiment=crm", "tracking=none", f"trainer.accelerator={device}"]
    words += ["scale=paper", f"model=mask2former_{network}", f"dataset.root={root}"]
    words += [f"trainer.{name}={NEVER}" for name in ("max_steps", "eval_every")]
    words += ["trainer.log_every=1", "data.num_workers=0", f"data.cache={root / 'cache'}"]
    if device == "cpu":
        words += ["model=mask2former_tiny", "recipe.batch_size=2", "scale.crop_hw=[64,96]"]
        words += ["scale.num_points=64", "trainer.threads=1"]
    words += ROWS[row]
    setup = set_up_training(specify(compose(words), words), upstream_finished=False)
    if row == "not_fused":
        for optimizer in setup.optimizers.values():
            for group in optimizer.param_groups:
                group["fused"] = None  # torch chooses: on CUDA, some kernels for all tensors
    return setup


def now(device: torch.device) -> float:
    """Time in seconds when the device has finished."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return time.perf_counter()


@contextmanager
def timed(device: torch.device, found: list[tuple[float, float]]) -> Iterator[None]:
    """Add seconds and peak memory (MiB; 0 on a CPU) of the block, with all its work on a device."""
    on_gpu, peak = device.type == "cuda", 0.0
    if on_gpu:
        torch.cuda.reset_peak_memory_stats(device)
    began = now(device)
    yield
    seconds = now(device) - began
    if on_gpu:
        peak = torch.cuda.max_memory_allocated(device) / 2**20
    found.append((seconds, peak))


def summary(found: list[tuple[float, float]], batch_size: int) -> dict[str, float]:
    """Medians over timed steps, and the peak."""
    seconds = [step for step, _ in found]
    step = median(seconds)
    return {
        "images/s": batch_size / step,
        "ms a step": 1e3 * step,
        "longest ms": 1e3 * max(seconds),
        "peak MiB": max(peak for _, peak in found),
    }


def watched(
    batches: Iterator[Any],
    device: torch.device,
    ours: list[tuple[float, float]],
    between: Callable[[], object],
) -> Iterator[Any]:
    """Give batches to a training, whose steps are timed."""
    for _ in range(sum(STEPS[device.type])):
        with timed(device, ours):
            yield next(batches)
        between()


def train(
    setup: TrainingSetup, batches: Iterator[Any], folder: Path, **changes: Any
) -> list[dict[str, float]]:
    """Train as long as there are batches, too few for a checkpoint; what each step logged."""
    recorded: list[dict[str, float]] = []
    hooks = Hooks()
    hooks.log = lambda step, values: recorded.append(values)  # type: ignore[method-assign]
    trainer = trainer_of(setup, folder, hooks, **changes)
    with suppress(StopIteration):
        trainer.fit(batches, State(seed=0))
    return recorded


def release_call(checkout: Path, setup: TrainingSetup, batch: Any) -> Callable[[], object]:
    """A step of the release with the same sizes and images."""
    from tests.benchmarks.release_step import release_step  # it replaces modules

    images = 255 * torch.cat([batch.rgb, batch.thermal], dim=1)
    size, (height, width) = len(images), images.shape[-2:]
    hidden = torch.rand(size, 1, 1, height // 32, width // 32) < 0.5  # complementary cells, as CRM
    hidden = hidden.repeat_interleave(8, 3).repeat_interleave(8, 4)
    return release_step(
        checkout,
        dict(setup.session.spec.model.plain),
        num_points=setup.session.spec.plain["scale"]["num_points"],
        images=images,
        label=batch.label.cpu(),
        hidden=torch.cat([hidden, ~hidden], dim=1).float(),
    )


def operations(step: Callable[..., object], _: torch.device) -> dict[str, Any]:
    """Operations of one step, a multiplication and its addition being two."""
    with FlopCounterMode(display=False) as counter:
        step(compile="none")
    return {"flops": counter.get_total_flops()}


def kernels(step: Callable[..., object], device: torch.device) -> dict[str, Any]:
    """Kernels and copies of one step; on a CPU operators."""
    on_gpu = device.type == "cuda"
    activity, kind = ProfilerActivity.CPU, DeviceType.CPU
    if on_gpu:
        activity, kind = ProfilerActivity.CUDA, DeviceType.CUDA
    with profile(activities=[activity]) as profiled:
        step()
        now(device)
    name = "self_device_time_total" if on_gpu else "self_cpu_time_total"
    rows = [row for row in profiled.key_averages() if row.device_type == kind]
    rows.sort(key=lambda row: getattr(row, name), reverse=True)
    top = []
    for row in rows[:KERNELS]:
        top.append({"name": row.key, "ms": getattr(row, name) / 1e3, "calls": row.count})
    return {
        "kernels": sum(row.count for row in rows),
        "kernel ms": sum(getattr(row, name) for row in rows) / 1e3,
        "top": top,
    }


def measure(row: str, network: str, device: str, root: Path, checkout: Path) -> dict[str, Any]:
    """Everything of one row."""
    if not (root / "train.txt").exists():
        write_images(root, *((28, (480, 640)) if device == "cuda" else (4, (96, 128))))
    setup = set_up(row, network, device, root)
    place, loading = setup.session.device, setup.session.loading
    warm, number = STEPS[place.type]
    batches: Iterator[Any] = setup.batches(range(warm + number + 1))
    ours, theirs = list[tuple[float, float]](), list[tuple[float, float]]()
    release: Callable[[], object] | None = None
    if loading.num_workers == 0:
        batch = next(batches).to(place)
        batches = repeat(OnDevice(batch))
        release = release_call(checkout, setup, batch) if row == "release" else None

    def between() -> None:
        if release is not None:
            with timed(place, theirs):
                release()

    recorded = train(setup, watched(batches, place, ours, between), root)
    found: dict[str, Any] = summary(ours[warm:], loading.batch_size)
    found["loss"] = recorded[0]["loss"]
    found["waiting"] = median(values[WAIT_SHARE] for values in recorded[warm : warm + number])
    if theirs:
        del found["waiting"]  # the steps of the release are in it
        found["release"] = summary(theirs[warm:], loading.batch_size)
        pairs = zip(theirs[warm:], ours[warm:], strict=True)
        found["ratio"] = median(their / our for (their, _), (our, _) in pairs)
    if row == EXAMINED:
        found["crop"] = list(batch.rgb.shape[-2:])

        def step(**changes: Any) -> None:
            train(setup, repeat(OnDevice(batch), 1), root, **changes)

        for examine in (operations, kernels):
            try:
                found |= examine(step, place)
            except Exception as error:  # the times count without it
                found[f"{examine.__name__} failed"] = f"{type(error).__name__}: {error}"[:300]
    return found | {"batch": loading.batch_size, "machine": about(setup)}


def about(setup: TrainingSetup) -> dict[str, Any]:
    """Machine, versions and code of the figures."""
    network = type(setup.session.model).__name__
    parameters = sum(weights.numel() for weights in setup.session.model.parameters())
    versions = {"python": platform.python_version(), "torch": torch.__version__}
    commit = {name: code()[name] for name in ("git_commit", "git_dirty")}
    return {**machine(), **versions, **commit, "network": network, "parameters": parameters}


if __name__ == "__main__":
    row, network, device, root, *more = sys.argv[1:]
    result = measure(row, network, device, Path(root), Path(*more))
    print(json.dumps(result))
