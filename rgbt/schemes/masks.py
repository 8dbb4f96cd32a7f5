"""The masks of a batch, drawn the same for any number of processes."""

from __future__ import annotations

import torch

from rgbt.processes import own, whole
from rgbt.types import AnyMasker, Batch, MaskPair


def draw_masks(masker: AnyMasker, batch: Batch, generator: torch.Generator) -> MaskPair:
    """Hidden cells of the samples of this process, (B, h, w) bool each.

    The masker draws for the samples of all processes, so that it needs to know nothing of them.
    """
    height, width = batch.rgb.shape[-2:]
    masks = masker((height, width), whole(batch.centre_yx), generator)
    return MaskPair(*(own(mask) for mask in masks))
