"""Settings of the training loop, and the recipes and scales that provide them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.ranges import (
    BaseWidth,
    BatchSize,
    LearningRate,
    Lengths,
    NonNegative,
    NumDevices,
    NumPoints,
    NumSteps,
    NumStepsOrZero,
    Pixels,
    Positive,
    ShareBelowOne,
    Size,
    Text,
    Threads,
    Workers,
)

Precision = Literal["32-true", "bf16-mixed"]
Compile = Literal["none", "default", "max-autotune"]
Averaging = Literal["none", "ema", "last"]

OF_MACHINE = (
    *("accelerator", "log_every", "checkpoint_every", "devices"),
    *("activation_checkpointing", "memory_format", "compile"),
)
"""Settings of the training loop that do not change the result."""


@dataclass(frozen=True, kw_only=True)
class TrainerSettings:
    """Durations, precision and checkpoints of one run.

    Attributes:
        max_steps: optimiser steps, >= 1.
        eval_every: steps between evaluations on the selection split, if there is one; the last step
            is always evaluated.
        checkpoint_every: steps between checkpoints; every evaluation writes one too.
        log_every: steps between lines in metrics.jsonl.
        accumulate: batches whose gradients are averaged into one optimiser step.
        clip_norm: largest L2 norm of all gradients together; null disables clipping.
        precision: "32-true" or "bf16-mixed".
        accelerator: "auto" uses a GPU if there is one.
        threads: of the CPU's arithmetic, >= 1, independent of the machine's cores: the bits of a
            result depend on it. Older runs (null) used one thread per core.
        selection_split: split whose mIoU selects the best checkpoint. Released: "test".
        tested: checkpoint for the test split: "best", with the highest mIoU on the selection
            split, or "last", if that split has no images of the target domain. "last" does not need
            that split: if the data set has no image of it, nothing is evaluated during training.
        averaging: weights that are evaluated and tested. "none": those of the last step, as
            published. "ema": their exponential moving average over the steps. "last": the mean of
            those after each of the last steps; before these begin, the weights of the last step.
        ema_decay: averaging=ema: after step n the average is d times itself plus (1 - d) times the
            weights, with d the smaller of `ema_decay` and n / (n + 9), 0 <= d < 1.
        averaged_share: averaging=last: share of all steps that are averaged, in (0, 1].
        devices: devices of each machine, with one process each; "auto": all that the accelerator
            has. They divide every batch, so that the result does not depend on their number. Under
            torchrun or srun, the processes that were started count.
        batch_norm_parts: parts of a batch that are normalised separately in training. 1: the whole
            batch, synchronised over the devices, as in all recipes here; else the number of
            devices.
        activation_checkpointing: whether activations of the blocks that the network names
            (`Record.recomputed`) are computed again in the backward pass instead of kept: less
            memory, more time, the same losses.
        memory_format: layout of convolutions' kernels, and so of feature maps, in memory; the
            result differs by rounding alone.
        compile: mode of `torch.compile` for the network in training; "none" does not compile,
            "max-autotune" leaves out CUDA graphs.
    """

    max_steps: NumSteps
    eval_every: NumSteps
    checkpoint_every: NumSteps
    log_every: NumSteps
    accumulate: Annotated[int, Interval(ge=1, le=10_000)]
    clip_norm: Positive | None
    precision: Precision
    accelerator: Literal["auto", "cpu", "cuda", "mps"]
    threads: Threads
    selection_split: Text
    tested: Literal["best", "last"] = "best"
    averaging: Averaging = "none"
    ema_decay: ShareBelowOne = 0.99
    averaged_share: Annotated[float, Interval(gt=0, le=1)] = 0.25
    devices: NumDevices | Literal["auto"] = 1
    batch_norm_parts: NumDevices = 1
    activation_checkpointing: bool = False
    memory_format: Literal["contiguous", "channels_last"] = "contiguous"
    compile: Compile = "none"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Published numbers in which methods and data sets differ; `scale=paper` uses them.

    Attributes:
        dataset: name of the data set for which the sizes and steps were published; a run at
            `scale=paper` on another one prints a warning.
        batch_size: samples per step, of all devices together.
        max_steps: optimiser steps.
        eval_every: steps between evaluations.
        train_sizes: shortest edges that the training resize draws from, pixels; null keeps the
            files' size.
        crop_hw: training crop, pixels; null takes whole images.
        lr: base learning rate.
        backbone_multiplier: factor of `lr` for what is pretrained.
        critic_lr: learning rate of a discriminator, where the scheme has one.
        clip_norm: largest gradient norm; null for none.
        warmup_steps: linear warm-up.
        demo_steps: optimiser steps at scale=demo.
        demo_sizes: shortest edges at scale=demo, which uses only these two settings.
    """

    dataset: Text
    batch_size: BatchSize
    max_steps: NumSteps
    eval_every: NumSteps
    train_sizes: Lengths
    crop_hw: Size
    lr: LearningRate
    backbone_multiplier: NonNegative
    critic_lr: LearningRate
    clip_norm: Positive | None
    warmup_steps: NumStepsOrZero
    demo_steps: NumSteps
    demo_sizes: Lengths


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The size of an experiment: values that other groups refer to as ``${scale.*}``.

    All other attributes are those of `Recipe`.

    Attributes:
        name: of its file.
        pixel_factor: size of a scale's images relative to the paper's, for ``${px:...}``.
        train_sizes: shortest edges that the training resize draws from, pixels; null keeps the
            files' size.
        crop_hw: training crop, pixels; null takes whole images.
        test_short_edge: shortest edge of the images in evaluation; null keeps the files' size.
            Counts are always taken at the resolution of the label file.
        num_points: points per mask at which the set criterion compares masks.
        eval_batch_size: images per evaluation batch.
        num_workers: loader processes.
        critic_width: channels of a discriminator's first convolution, where there is one.
        precision: see `TrainerSettings`.
        pretrained: whether the recipe starts from ImageNet weights; a run without them prints a
            warning.
        few_scenes: whether embedded data sets have a handful of scenes, for ``${scenes:...}``.
    """

    name: Text
    pixel_factor: Annotated[float, Interval(gt=0, le=16)]
    train_sizes: Lengths | None
    crop_hw: Size | None
    test_short_edge: Pixels | None
    num_points: NumPoints
    batch_size: BatchSize
    eval_batch_size: BatchSize
    num_workers: Workers
    max_steps: NumSteps
    eval_every: NumSteps
    lr: LearningRate
    backbone_multiplier: NonNegative
    critic_width: BaseWidth
    critic_lr: LearningRate
    clip_norm: Positive | None
    warmup_steps: NumStepsOrZero
    precision: Precision
    pretrained: bool
    few_scenes: bool = False
