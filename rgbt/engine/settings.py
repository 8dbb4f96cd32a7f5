"""Settings of the training loop, and the recipes and scales that provide them.

conf/trainer/default.yaml, conf/recipe/mfnet.yaml and conf/scale/demo.yaml explain the keys.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval
from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from rgbt import ranges

Precision = Literal["32-true", "bf16-mixed"]

# Settings of the training loop that do not change the result.
MACHINE_SETTINGS = (
    "accelerator",
    "matmul_precision",
    "log_every",
    "checkpoint_minutes",
    "checkpoint_evaluations",
    "devices",
    "activation_checkpointing",
    "memory_format",
    "compile",
)


def _not_gpu(value: object) -> object:
    if value == "gpu":
        raise PydanticCustomError(
            "gpu", "write cuda for a GPU of NVIDIA or AMD, mps for one of Apple"
        )
    return value


@dataclass(frozen=True, kw_only=True)
class TrainerSettings:
    """Durations, precision and checkpoints of one run.

    Devices divide every batch, so that the result does not depend on their number.
    """

    max_steps: ranges.NumSteps
    eval_every: ranges.NumSteps
    checkpoint_minutes: Annotated[float, Interval(ge=0, le=1440)] = 10.0
    checkpoint_evaluations: bool = False
    log_every: ranges.NumSteps
    accumulate: Annotated[int, Interval(ge=1, le=10_000)]
    clip_norm: ranges.Positive | None
    precision: Precision
    accelerator: Annotated[Literal["auto", "cpu", "cuda", "mps"], BeforeValidator(_not_gpu)]
    threads: ranges.Threads
    selection_split: ranges.Text
    tested: Literal["best", "last"] = "best"
    matmul_precision: Literal["high", "highest"] = "high"
    averaging: Literal["none", "ema", "last"] = "none"
    ema_decay: ranges.ShareBelowOne = 0.99
    averaged_share: Annotated[float, Interval(gt=0, le=1)] = 0.25
    devices: ranges.NumDevices | Literal["auto"] = 1
    batch_norm_parts: ranges.NumDevices = 1
    activation_checkpointing: bool = False
    memory_format: Literal["contiguous", "channels_last"] = "contiguous"
    compile: Literal["auto", "none", "functions", "default", "max-autotune"] = "auto"


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Published numbers in which methods and data sets differ, which `scale=paper` uses."""

    dataset: ranges.Text
    batch_size: ranges.BatchSize
    max_steps: ranges.NumSteps
    eval_every: ranges.NumSteps
    train_sizes: ranges.Lengths
    crop_hw: ranges.Size
    lr: ranges.LearningRate
    backbone_multiplier: ranges.NonNegative
    critic_lr: ranges.LearningRate
    clip_norm: ranges.Positive | None
    warmup_steps: ranges.NumStepsOrZero
    demo_steps: ranges.NumSteps
    demo_sizes: ranges.Lengths


@dataclass(frozen=True, kw_only=True)
class Scale:
    """The size of an experiment: values that other groups refer to as ``${scale.*}``."""

    name: ranges.Text
    pixel_factor: Annotated[float, Interval(gt=0, le=16)]
    train_sizes: ranges.Lengths | None
    crop_hw: ranges.Size | None
    test_short_edge: ranges.Pixels | None
    num_points: ranges.NumPoints
    batch_size: ranges.BatchSize
    eval_batch_size: ranges.BatchSize
    num_workers: ranges.Workers
    max_steps: ranges.NumSteps
    eval_every: ranges.NumSteps
    lr: ranges.LearningRate
    backbone_multiplier: ranges.NonNegative
    critic_width: ranges.BaseWidth
    critic_lr: ranges.LearningRate
    clip_norm: ranges.Positive | None
    warmup_steps: ranges.NumStepsOrZero
    precision: Precision
    pretrained: bool
    few_scenes: bool = False
