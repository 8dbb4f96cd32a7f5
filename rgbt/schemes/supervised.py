"""Supervised training with one pass and one loss."""

from __future__ import annotations

from collections.abc import Iterator

from torch import nn

from rgbt.requirements import Record, record_of
from rgbt.schemes.domains import SourceAndTarget, draw_masks, options_of
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, Phase


class Supervised:
    """Train on the labels with one pass; a masker that hides something masks that pass.

    Args:
        model: the network.
        loss: of its output and the labels.
        masker: draws the hidden cells.
        domains: view and head of the source.
    """

    record = Record(shows_views=True)

    def __init__(
        self, *, model: nn.Module, loss: Loss, masker: AnyMasker, domains: SourceAndTarget
    ) -> None:
        self.model = model
        self.loss = loss
        self.masker = masker
        self.hides_cells = record_of(masker).hides_cells
        self.options = options_of(domains.source)

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase with the parts of the loss."""
        masks = None
        if self.hides_cells:
            masks = draw_masks(self.masker, batch, generator_of("mask"))
        generator = generator_of("stochastic depth")
        output = self.model(batch.rgb, batch.thermal, masks, generator=generator, **self.options)
        parts = self.loss(output, batch, generator_of("loss"))
        del output  # the loop holds this frame until all accumulated batches are done
        yield Phase(("main",), {name: values.sum() for name, values in parts.items()})
