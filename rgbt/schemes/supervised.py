"""Supervised training with one pass and one loss."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import ClassVar

from torch import nn

from rgbt.requirements import MaskerRecord, SchemeRecord, record_of
from rgbt.schemes.domains import SourceAndTarget, draw_masks, options_of
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, Phase


@dataclass(kw_only=True, eq=False)
class Supervised:
    """Train on the labels with one pass; a masker that hides something masks that pass."""

    model: nn.Module
    loss: Loss
    masker: AnyMasker
    domains: SourceAndTarget
    record: ClassVar[SchemeRecord] = SchemeRecord(shows_views=True)

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase with the parts of the loss."""
        masks = None
        if record_of(self.masker, MaskerRecord).hides_cells:
            masks = draw_masks(self.masker, batch, generator_of("mask"))
        options = options_of(self.domains.source)
        generator = generator_of("stochastic depth")
        output = self.model(batch.rgb, batch.thermal, masks, generator=generator, **options)
        parts = self.loss(output, batch, generator_of("loss"))
        del output  # the loop holds this frame until all accumulated batches are done
        yield Phase(("main",), {name: values.sum() for name, values in parts.items()})
