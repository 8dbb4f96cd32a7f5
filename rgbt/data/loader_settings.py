"""Settings of the loader, in a module that does not import torch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.ranges import BatchSize, NonNegative, Positive, Text, Workers

LOADING = ("num_workers", "on_error", "eval_batch_size", "prefetch", "cache")
"""Settings that do not change the samples of a batch."""

OF_RARE_CLASSES = ("class_temperature", "min_class_pixels", "min_crop_ratio")
"""Settings that have an effect with `sampling` "rare_classes" alone."""


@dataclass(frozen=True)
class LoaderSettings:
    """How samples are loaded.

    Attributes:
        batch_size: samples of a training batch, >= 1; of all devices together, which share it
            equally.
        eval_batch_size: samples of an evaluation batch, >= 1; 1 where image sizes differ.
        num_workers: processes that decode and augment; 0: the main process does.
        prefetch: batches that each process makes in advance.
        cache: images are decoded once into memory-mapped files of this folder and read from there
            (`rgbt.data.cache`); "auto": in the folder of the user's cache; None: no such files.
        on_error: "raise" stops at an unreadable file; "skip" reports it once and uses the next
            readable sample of the list instead (training) or skips it (evaluation).
        sampling: "shuffled": every image of the source once per epoch; "rare_classes": images of
            the source drawn by their classes (`rgbt.data.rare_classes`). The images of a target are
            always shuffled.
        class_temperature: sampling=rare_classes: T, > 0; DAFormer: 0.01.
        min_class_pixels: the same: an image is drawn for a class with more pixels of it than that,
            in the label as stored; DAFormer: 3000.
        min_crop_ratio: the same: a crop is drawn again, up to 10 times, until it has more than this
            share of `min_class_pixels`; 0: never. DAFormer: 0.5; HRDA and MIC: 2.
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
