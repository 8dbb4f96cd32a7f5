"""Class mixing: the pixels of some classes of a source image, pasted on a target image."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.processes import mean_count, own_draw
from rgbt.types import Batch, View

NUM_VALUES = 256
"""Values of a label: the classes and 255, which is pasted like a class."""

LUMA = (0.299, 0.587, 0.114)
"""Of red, green and blue (ITU-R BT.601)."""


def pasted_pixels(label: Tensor, generator: torch.Generator) -> Tensor:
    """(B, H, W) bool: the pixels of half of the classes, drawn for every image.

    With n values in the labels of the batch, ceil(n / 2) of them are drawn for each image, without
    replacement. A drawn value that the image does not have pastes nothing.

    Source: ClassMix; DACS.   Released: DACS, DAFormer, HRDA and MIC, whose values are those of the
    batch and include 255.

    Args:
        label: (B, H, W) int64, 0..255.
        generator: on the device of `label`.
    """
    present = torch.zeros(NUM_VALUES, device=label.device)
    present = mean_count(present.index_fill(0, label.flatten(), 1.0)) > 0

    def draw(count: int) -> Tensor:
        return torch.rand(count, NUM_VALUES, generator=generator, device=label.device)

    # The present values come first, in random order; the number of draws does not depend on them.
    order = (own_draw(draw, len(label)) + ~present).argsort(1)
    place = torch.arange(NUM_VALUES, device=label.device).expand_as(order)
    rank = torch.empty_like(order).scatter_(1, order, place)
    drawn = rank < (present.sum() + 1) // 2
    return drawn.gather(1, label.flatten(1)).view_as(label)


def mixed(source: Batch, target: Batch, pasted: Tensor) -> Batch:
    """The target with the pixels `pasted` (B, H, W) of the source in both images and the label.

    Pasted pixels have weight 1; the others keep the confidence of the target, which it must have.

    Raises:
        InputError: images of another size.
    """
    sizes = [tuple(batch.rgb.shape[-2:]) for batch in (source, target)]
    if sizes[0] != sizes[1]:
        own, other = (" x ".join(map(str, size)) for size in sizes)
        raise InputError(
            f"scheme.mixing=classes requires source and target images of one size, got {own} and "
            f"{other} pixels; choose a transform that crops to one size, or scheme.mixing=none."
        )
    assert target.confidence is not None, "pseudo-labels have a weight"
    return replace(
        target,
        rgb=source.rgb.where(pasted[:, None], target.rgb),
        thermal=source.thermal.where(pasted[:, None], target.thermal),
        label=source.label.where(pasted, target.label),
        confidence=torch.ones_like(target.confidence).where(pasted, target.confidence),
    )


def seen_as(batch: Batch, own: View | None, other: View | None) -> Batch:
    """The batch with what its domain sees, in the channels that another domain sees.

    RGB becomes thermal as its luma; thermal becomes RGB as grey. A domain that sees RGB alone has
    no thermal images to paste. Domains with the same view, or with both images, paste what they
    have.
    """
    if {own, other} != {"rgb", "thermal"}:
        return batch
    if other == "rgb":
        return replace(batch, rgb=batch.thermal.expand_as(batch.rgb))
    luma = batch.rgb.new_tensor(LUMA).view(1, 3, 1, 1)
    return replace(batch, thermal=(batch.rgb * luma).sum(1, keepdim=True))
