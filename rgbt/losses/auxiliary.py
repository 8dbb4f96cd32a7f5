"""A second set of class scores, taken from the middle of a network, trained along."""

from __future__ import annotations

import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.ranges import NonNegative
from rgbt.types import Batch, Loss, Output


class WithAuxiliary:
    """A loss of the class scores plus ``weight`` times the same loss of the auxiliary ones.

    Source: PSPNet (0.4); AdaptSegNet, Eq. 5, and MaxSquareLoss (0.1); thesis (J. Sun), code (0.1
    with maximum squares).

    Args:
        loss: of class scores.
        weight: finite, >= 0.

    Attributes:
        reads: what `loss` reads; None where it does not say.

    Raises:
        InputError: a weight out of range.
    """

    def __init__(self, *, loss: Loss, weight: NonNegative) -> None:
        self.loss = loss
        self.weight = weight
        self.reads_confidence = getattr(loss, "reads_confidence", False)
        self.reads = getattr(loss, "reads", None)

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """The parts of `loss`, and those of the auxiliary scores as <part>_aux.

        Args:
            output: with `aux["aux_logits"]` of the shape of its logits.
            batch: see `loss`.
            generator: of `loss`, the scores first.

        Returns:
            weighted parts, shapes as those of `loss`.

        Raises:
            InputError: a network without auxiliary head.
        """
        if "aux_logits" not in output.aux:
            raise InputError(
                "loss=cross_entropy_auxiliary needs a network with an auxiliary head, and this one "
                "returns no auxiliary scores; choose a DeepLab v2 with model.auxiliary=true, or "
                "loss=cross_entropy."
            )
        parts = self.loss(output, batch, generator)
        auxiliary = self.loss(Output(output.aux["aux_logits"], {}), batch, generator)
        return {**parts, **{f"{name}_aux": self.weight * part for name, part in auxiliary.items()}}
