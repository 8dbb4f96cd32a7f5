"""What the loop is told by the configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from rgbt.checks import InputError


@dataclass(frozen=True, kw_only=True)
class TrainerSettings:
    """Durations, precision and checkpoints of one run.

    Attributes:
        max_steps: optimiser steps, >= 1.
        eval_every: steps between evaluations on the selection split; the last step is always
            evaluated.
        checkpoint_every: steps between checkpoints; every evaluation writes one too.
        log_every: steps between lines in metrics.jsonl.
        accumulate: batches whose gradients are averaged into one optimiser step.
        clip_norm: largest L2 norm of all gradients together; null leaves them as they are.
        precision: "32-true" or "bf16-mixed".
        accelerator: "auto" takes a GPU where there is one.
        threads: CPU threads; null leaves torch's choice.
        selection_split: split whose mIoU picks the best checkpoint. Released: "test".
        tested: what the test split is evaluated with: "best", the checkpoint with the highest mIoU
            on the selection split, or "last", where that split says little (it holds no images
            of the target domain).
    """

    max_steps: int
    eval_every: int
    checkpoint_every: int
    log_every: int
    accumulate: int
    clip_norm: float | None
    precision: Literal["32-true", "bf16-mixed"]
    accelerator: Literal["auto", "cpu", "cuda", "mps"]
    threads: int | None
    selection_split: str
    tested: Literal["best", "last"] = "best"

    def __post_init__(self) -> None:
        for name in ("max_steps", "eval_every", "checkpoint_every", "log_every", "accumulate"):
            if getattr(self, name) < 1:
                raise InputError(f"trainer.{name} must be at least 1, got {getattr(self, name)}.")
        if self.threads is not None and self.threads < 1:
            raise InputError(f"trainer.threads must be at least 1 or null, got {self.threads}.")
        if self.clip_norm is not None and self.clip_norm <= 0:
            raise InputError(f"trainer.clip_norm must be positive or null, got {self.clip_norm}.")


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Published numbers in which methods and data sets differ; `scale=paper` takes them.

    Attributes:
        dataset: name of the data set that the sizes and steps are for; on another one a run at
            `scale=paper` says so.
        batch_size: samples per process and step.
        max_steps: optimiser steps.
        eval_every: steps between evaluations.
        train_sizes: shortest edges that the training resize draws from, pixels.
        crop_hw: training crop, pixels.
        lr: base learning rate.
        backbone_multiplier: factor of `lr` for what is pretrained.
        critic_lr: learning rate of a critic, where the scheme has one.
        clip_norm: largest gradient norm; null for none.
        warmup_steps: linear warm-up.
        demo_steps: optimiser steps at scale=demo.
        demo_sizes: shortest edges at scale=demo, which takes nothing else from here.
    """

    dataset: str
    batch_size: int
    max_steps: int
    eval_every: int
    train_sizes: tuple[int, ...]
    crop_hw: tuple[int, int]
    lr: float
    backbone_multiplier: float
    critic_lr: float
    clip_norm: float | None
    warmup_steps: int
    demo_steps: int
    demo_sizes: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Scale:
    """How big an experiment is run: the sizes that other groups refer to as ``${scale.*}``.

    Attributes:
        name: of its file.
        pixel_factor: size of a scale's images relative to the paper's, for ``${px:...}``.
        train_sizes: shortest edges that the training resize draws from, pixels.
        crop_hw: training crop, pixels.
        test_short_edge: shortest edge of the images in evaluation; null keeps the files' size.
            Counts are always taken at the resolution of the label file.
        num_points: points per mask at which the set criterion compares masks.
        batch_size: samples per training batch.
        eval_batch_size: images per evaluation batch.
        num_workers: loader processes.
        max_steps: optimiser steps.
        eval_every: steps between evaluations.
        lr: base learning rate.
        backbone_multiplier: factor of `lr` for the backbone.
        critic_width: channels of a critic's first convolution, where the scheme has a critic.
        critic_lr: learning rate of a critic, where the scheme has one.
        clip_norm: largest gradient norm; null for none.
        warmup_steps: linear warm-up.
        precision: see `TrainerSettings`.
        pretrained: whether the recipe starts from weights of ImageNet; a run that does not is told.
        few_scenes: whether embedded data sets have a handful of scenes, for ``${scenes:...}``.
    """

    name: str
    pixel_factor: float
    train_sizes: tuple[int, ...]
    crop_hw: tuple[int, int]
    test_short_edge: int | None
    num_points: int
    batch_size: int
    eval_batch_size: int
    num_workers: int
    max_steps: int
    eval_every: int
    lr: float
    backbone_multiplier: float
    critic_width: int
    critic_lr: float
    clip_norm: float | None
    warmup_steps: int
    precision: str
    pretrained: bool
    few_scenes: bool = False
