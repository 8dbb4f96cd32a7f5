"""A loss of auxiliary class scores from the middle of a network."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from rgbt.ranges import NonNegative
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import Batch, Loss, Output


@dataclass(frozen=True, kw_only=True)
class WithAuxiliary:
    """A loss of the class scores plus ``weight`` times the same loss of the auxiliary ones.

    Source: PSPNet (0.4); AdaptSegNet, Eq. 5, and MaxSquareLoss (0.1); thesis (J. Sun), code (0.1
    with maximum squares).

    Attributes:
        loss: of class scores.
        weight: finite, >= 0.
    """

    loss: Loss
    weight: NonNegative

    @property
    def record(self) -> Record:
        """That of `loss`, and a network with an auxiliary head."""
        record = record_of(self.loss)
        auxiliary = Requirement("model", "auxiliary", True)
        return replace(record, requires=(*record.requires, auxiliary), reads_auxiliary=True)

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """The weighted parts of `loss`, and those of `aux["aux_logits"]` as <part>_aux.

        `generator` is drawn from for the scores first; shapes as those of `loss`.
        """
        parts = self.loss(output, batch, generator)
        auxiliary = self.loss(Output(output.aux["aux_logits"], {}), batch, generator)
        return {**parts, **{f"{name}_aux": self.weight * part for name, part in auxiliary.items()}}
