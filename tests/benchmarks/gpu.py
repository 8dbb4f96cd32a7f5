"""Figures that need a GPU: CRM steps at paper size, compiled or recomputed, and the input path.

Every row is a training in the project's own loop with random images of MFNet's size; a row that
fails is printed with its error. TF32 is off in rows fp32. The tests marked gpu compare losses with
the CPU: ``pytest -m gpu tests/on_device``.

Run: python -m tests.benchmarks.gpu [minutes=3] [device=cpu, the smallest sizes]
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from itertools import repeat
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import torch

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import WAIT_SHARE, Hooks, Trainer
from rgbt.runs.specify import specify

WARM, STEPS, NEVER = 3, 8, 1_000_000
PRECISIONS = {"fp32": "32-true", "tf32": "32-true", "bf16": "bf16-mixed"}
CASES = (
    *(("swin_s", each, "") for each in PRECISIONS),
    *(("swin_t", each, "") for each in ("fp32", "bf16")),
    ("swin_t", "bf16", "data.num_workers=4"),
    ("swin_s", "bf16", "trainer.activation_checkpointing=true"),
    ("swin_s", "bf16", "trainer.compile=default"),
    ("swin_b", "bf16", ""),
)
"""Network, precision and a setting; images are on the device unless the setting is of the data."""


@dataclass
class Watched:
    """Batches of a training, the times at which they were asked for; the last one ends it."""

    batches: Iterator[Any]
    wait: bool
    times: list[float] = field(default_factory=list)

    def __iter__(self) -> Watched:
        return self

    def __next__(self) -> Any:
        """The next batch; `KeyboardInterrupt` after the last step."""
        if self.wait and torch.cuda.is_available():
            torch.cuda.synchronize()
        self.times.append(time.perf_counter())
        if len(self.times) > WARM + STEPS:
            raise KeyboardInterrupt
        return next(self.batches)


class OnDevice:
    """A batch that is on the device already."""

    def __init__(self, batch: Any) -> None:
        self.batch, self.name = batch, batch.name

    def to(self, device: torch.device) -> Any:
        """The batch."""
        return self.batch


def write_images(folder: Path, count: int, hw: tuple[int, int]) -> Path:
    """A data set in MFNet's layout; smooth noise compresses about as well as photographs do."""
    rng = np.random.default_rng(0)
    names = [f"{number:05d}D" for number in range(count)]
    for each in ("images", "labels"):
        (folder / each).mkdir(parents=True)
    for name in names:
        coarse = rng.integers(0, 256, (hw[0] // 4, hw[1] // 4, 4), dtype=np.uint8)
        cells = rng.integers(0, 9, (4, 5), dtype=np.uint8)
        image = cv2.resize(coarse, hw[::-1], interpolation=cv2.INTER_LINEAR)
        label = cv2.resize(cells, hw[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / "images" / f"{name}.png"), image)
        cv2.imwrite(str(folder / "labels" / f"{name}.png"), label)
    for split, listed in (("train", names), ("val", names[:1]), ("test", names[:1])):
        (folder / f"{split}.txt").write_text("\n".join(listed) + "\n")
    return folder


def set_up(network: str, precision: str, setting: str, root: Path, device: str) -> TrainingSetup:
    """CRM as published (batch 14), or its smoke test on a CPU."""
    words = ["+experiment=crm", "tracking=none", f"trainer.accelerator={device}"]
    words += ["scale=paper", f"model=mask2former_{network}", f"dataset.root={root}"]
    words += [f"trainer.precision={PRECISIONS[precision]}", f"data.cache={root / 'cache'}"]
    words += [f"trainer.{name}={NEVER}" for name in ("max_steps", "eval_every")]
    words += ["trainer.checkpoint_minutes=1440", "trainer.log_every=1", *filter(None, [setting])]
    words += ["data.num_workers=0"] if "num_workers" not in setting else []
    if device == "cpu":
        words += ["model=mask2former_tiny", "recipe.batch_size=2", "scale.crop_hw=[64,80]"]
    torch.backends.cuda.matmul.allow_tf32 = torch.backends.cudnn.allow_tf32 = precision == "tf32"
    return set_up_training(specify(compose(words), words), upstream_finished=False)


def measure(setup: TrainingSetup, folder: Path, *, loading: bool) -> dict[str, float]:
    """Images per second, milliseconds a step, peak memory, and the share of waiting for images."""
    session = setup.session
    recorded: list[dict[str, float]] = []
    hooks = Hooks()
    hooks.log = lambda step, values: recorded.append(values)  # type: ignore[method-assign]
    trainer = Trainer(
        fabric=setup.fabric,
        settings=session.trainer,
        phases=setup.scheme.phases,
        model=setup.model,
        others=setup.others,
        optimizers=setup.optimizers,
        schedule=setup.schedule,
        steps_per_epoch=NEVER,
        folder=folder,
        hooks=hooks,
    )
    batches: Iterator[Any] = setup.batches(range(WARM + STEPS + 1))
    if not loading:
        batches = repeat(OnDevice(next(batches).to(session.device)))
    if session.device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    watched = Watched(batches, wait=not loading)
    try:
        trainer.fit(watched, State(seed=0))
    except KeyboardInterrupt:
        step = median(np.diff(watched.times)[WARM:].tolist())
    size = session.loading.batch_size
    peak = torch.cuda.max_memory_allocated() / 2**20 if session.device.type == "cuda" else 0.0
    return {
        "batch": size,
        "images/s": size / step,
        "ms a step": 1e3 * step,
        "peak MiB": peak,
        "waiting": median(values.get(WAIT_SHARE, 0.0) for values in recorded[WARM:]),
    }


def main(minutes: float = 3.0, device: str = "cuda") -> None:
    """Print one row of Markdown after the other, until the time is over."""
    began = time.perf_counter()
    name = torch.cuda.get_device_name() if device == "cuda" else "CPU"
    print(f"{name}, torch {torch.__version__}; CRM, crops of 256x320, median of {STEPS} steps\n")
    print("| network | setting | batch | images/s | ms a step | peak MiB | waiting |")
    print("|---|---|---|---|---|---|---|")
    with TemporaryDirectory() as scratch:
        count, hw = (28, (480, 640)) if device == "cuda" else (4, (96, 128))
        root = write_images(Path(scratch, "images"), count, hw)
        for network, precision, setting in CASES if device == "cuda" else CASES[:1]:
            if time.perf_counter() - began > 60 * minutes:
                break
            try:
                setup = set_up(network, precision, setting, root, device)
                found = measure(setup, Path(scratch), loading="data." in setting)
                cells = " | ".join(f"{value:.4g}" for value in found.values())
            except Exception as error:  # one row says why, the others are measured
                cells = f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"
            print(f"| {network} | {precision} {setting} | {cells} |", flush=True)


if __name__ == "__main__":
    given = dict(word.split("=", 1) for word in sys.argv[1:])
    main(float(given.get("minutes", 3.0)), given.get("device", "cuda"))
