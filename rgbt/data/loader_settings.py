"""Settings of the loader, in a module that does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.ranges import BatchSize, NonNegative, Positive, Text, Workers

# Settings that do not change the samples of a batch.
LOADING = ("num_workers", "on_error", "eval_batch_size", "prefetch", "cache")


@dataclass(frozen=True)
class LoaderSettings:
    """Says how samples are loaded; conf/config.yaml describes each setting.

    The samples of a batch are shared equally by all devices. `sampling`: the images of a target
    domain are always shuffled. `min_crop_ratio`: DAFormer 0.5, HRDA and MIC 2; 0: never again.
    """

    batch_size: BatchSize
    eval_batch_size: BatchSize
    num_workers: Workers
    prefetch: Annotated[int, Interval(ge=1, le=1024)] = 2
    cache: Text | None = None
    on_error: Literal["raise", "skip"] = "raise"
    sampling: Literal["shuffled", "rare_classes"] = "shuffled"
    class_temperature: Positive = 0.01
    min_class_pixels: Annotated[int, Interval(ge=0, le=10**8)] = 3000
    min_crop_ratio: NonNegative = 0.5
