"""One pass, one loss."""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn

from rgbt.types import Batch, GeneratorOf, Loss, Masker, Phase


class Supervised:
    """Train on the labels with one pass; a masker that hides something masks that pass."""

    def __init__(self, *, model: nn.Module, loss: Loss, masker: Masker) -> None:
        self.model = model
        self.loss = loss
        self.masker = masker

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase with the parts of the loss.

        Args:
            batch: see `rgbt.types.Batch`, images in [0, 1].
            generator_of: purpose -> generator of this step.
        """
        height, width = batch.rgb.shape[-2:]
        masks = None
        if not self.masker.hides_nothing:
            masks = self.masker((height, width), batch.centre_yx, generator_of("mask"))
        output = self.model(
            batch.rgb, batch.thermal, masks, generator=generator_of("stochastic depth")
        )
        parts = self.loss(output, batch, generator_of("loss"))
        yield Phase("main", {name: values.sum() for name, values in parts.items()})
