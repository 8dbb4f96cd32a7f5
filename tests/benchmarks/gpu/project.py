"""Objects of the project for the steps: set up as a training sets them up, on the device."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor

from rgbt.assembly.training_setup import TrainingSetup, set_up_training
from rgbt.config.compose import compose
from rgbt.engine.checkpoint import State
from rgbt.engine.trainer import Trainer
from rgbt.randomness import generators_of_step
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.specify import specify
from rgbt.types import Batch
from tests.benchmarks.gpu.device import wait

NEVER = 1_000_000
CLASSES = 9
DATA_HW = (480, 640)
"""Size of the images of MFNet."""


def spec_of(words: Sequence[str], device: torch.device) -> RunSpec:
    """The specification of a run on a device, without tracking."""
    common = (f"trainer.accelerator={device.type}", "tracking=none", "trainer.threads=2")
    every = (f"trainer.{name}={NEVER}" for name in ("max_steps", "eval_every", "checkpoint_every"))
    overrides = [*words, *common, *every, "trainer.log_every=1"]
    return specify(compose(overrides), overrides)


def setup_of(words: Sequence[str], device: torch.device) -> TrainingSetup:
    """The objects of a training with these overrides; upstream runs need not exist."""
    return set_up_training(spec_of(words, device), upstream_finished=False)


def smoke_words(experiment: str) -> list[str]:
    """Overrides of an experiment at smoke size that runs without its upstream runs.

    They would make pseudo-labels, whose confidence weighs a loss of HeatNet.
    """
    words = [f"+experiment={experiment}", "+debug=smoke", "data.num_workers=0"]
    scheme = specify(compose(words), words).scheme
    if scheme.plain.get("weighed_by_confidence"):
        words.append("scheme.weighed_by_confidence=false")
    return words


def crm_words(network: str, batch_size: int, root: Path, *, smoke: bool) -> list[str]:
    """Overrides of the CRM experiment as published, or at the smallest size."""
    if smoke:
        return ["+experiment=crm", "+debug=smoke", f"scale.batch_size={batch_size}"]
    sizes = [f"model={network}", f"recipe.batch_size={batch_size}", f"dataset.root={root}"]
    return ["+experiment=crm", "scale=paper", *sizes]


class EnoughStepsError(Exception):
    """The requested number of steps has been measured."""


@dataclass
class Watched:
    """Batches that end a training after some steps, and the times at which they were requested.

    Attributes:
        batches: endless.
        device: waited for before each reading, so that a step includes the work of the device.
        steps: steps before `EnoughStepsError`.
        synchronise: False: the host runs ahead of the device as in a training.
        times: readings of the clock, one more than steps.
    """

    batches: Iterator[Any]
    device: torch.device
    steps: int
    synchronise: bool = True
    times: list[float] = field(default_factory=list)

    def __iter__(self) -> Watched:
        return self

    def __next__(self) -> Any:
        """The next batch; `EnoughStepsError` after the last step."""
        if self.synchronise or len(self.times) in (0, self.steps):
            wait(self.device)
        self.times.append(time.perf_counter())
        if len(self.times) > self.steps:
            raise EnoughStepsError
        return next(self.batches)

    def seconds(self, skipped: int) -> list[float]:
        """Of each step, without the first ones."""
        return np.diff(self.times)[skipped:].tolist()


@dataclass(frozen=True)
class OnDevice:
    """A batch that is on the device already."""

    batch: Batch

    @property
    def name(self) -> tuple[str, ...]:
        """Names of the samples."""
        return self.batch.name

    def to(self, device: torch.device | str) -> Batch:
        """The batch."""
        return self.batch


@dataclass
class Training:
    """A training that can be run for a few steps.

    Attributes:
        setup: its objects.
        folder: for its checkpoints; none is written.
        recorded: values that each step logged.
    """

    setup: TrainingSetup
    folder: Path
    recorded: list[dict[str, float]] = field(default_factory=list)
    state: State = field(default_factory=lambda: State(seed=0))

    def run(self, batches: Iterator[Any], steps: int, *, synchronise: bool = True) -> Watched:
        """Train for some steps, in the project's own loop."""
        setup, session = self.setup, self.setup.session
        trainer = Trainer(
            fabric=setup.fabric,
            settings=session.trainer,
            scheme=setup.scheme,
            model=setup.model,
            others=setup.others,
            optimizers=setup.optimizers,
            schedule=setup.schedule,
            steps_per_epoch=NEVER,
            folder=self.folder,
            record=lambda step, values: self.recorded.append(dict(values)),
            validate=lambda step: 0.0,
        )
        watched = Watched(batches, session.device, steps, synchronise)
        try:
            trainer.fit(watched, self.state)
        except EnoughStepsError:
            return watched
        raise AssertionError("the training ended before the batches did")


def loss_of(setup: TrainingSetup, batch: Any, index: int = 0) -> Tensor:
    """The sum of all parts of one step, after its backward passes; no optimizer steps."""
    device = setup.session.device
    generator_of = generators_of_step(0, index, device)
    total = torch.zeros((), device=device)
    for phase in setup.scheme.phases(batch, generator_of):
        loss = torch.stack(list(phase.parts.values())).sum()
        setup.fabric.backward(loss)
        total = total + loss.detach()
    return total


def batch_on(device: torch.device, count: int, image_hw: tuple[int, int]) -> Batch:
    """A batch of noise with labels of rectangles, six to nine classes in each image."""
    generator = torch.Generator().manual_seed(1)
    height, width = image_hw
    cells = torch.randint(0, CLASSES, (count, 4, 5), generator=generator)
    label = cells.repeat_interleave(-(-height // 4), 1).repeat_interleave(-(-width // 5), 2)
    batch = Batch(
        rgb=torch.randint(0, 256, (count, 3, *image_hw), generator=generator, dtype=torch.uint8),
        thermal=torch.randint(0, 256, (count, 1, *image_hw), generator=generator).byte(),
        label=label[:, :height, :width].byte(),
        name=tuple(map(str, range(count))),
        centre_yx=torch.tensor([[height // 2, width // 2]]).expand(count, 2).clone(),
        position=None,
        original_hw=torch.tensor([image_hw]).expand(count, 2).clone(),
    )
    return batch.to(device)


def part_of(batch: Batch, count: int) -> Batch:
    """The first samples of a batch that tracks no positions and no confidences."""
    names = ("rgb", "thermal", "label", "centre_yx", "original_hw")
    parts = {name: getattr(batch, name)[:count] for name in names}
    return replace(batch, name=batch.name[:count], **parts)


def write_mfnet(folder: Path, count: int, hw: tuple[int, int] = DATA_HW) -> Path:
    """Write a data set in the layout of MFNet: `count` training images, one to validate and test.

    Smooth noise compresses about as well as photographs do, so that decoding takes as long.
    """
    rng = np.random.default_rng(0)
    names = [f"{number:05d}D" for number in range(count)]
    for each in ("images", "labels"):
        (folder / each).mkdir(parents=True)
    for name in names:
        coarse = rng.integers(0, 256, (hw[0] // 4, hw[1] // 4, 4), dtype=np.uint8)
        image = cv2.resize(coarse, hw[::-1], interpolation=cv2.INTER_LINEAR)
        cells = rng.integers(0, CLASSES, (4, 5), dtype=np.uint8)
        label = cv2.resize(cells, hw[::-1], interpolation=cv2.INTER_NEAREST)
        cv2.imwrite(str(folder / "images" / f"{name}.png"), image)
        cv2.imwrite(str(folder / "labels" / f"{name}.png"), label)
    for split, listed in (("train", names), ("val", names[:1]), ("test", names[:1])):
        (folder / f"{split}.txt").write_text("\n".join(listed) + "\n")
    return folder
