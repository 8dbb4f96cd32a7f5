"""Pixel-wise cross-entropy for networks that return dense class scores, and auxiliary ones."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import torch
from annotated_types import Len
from torch import Tensor
from torch.nn import functional as F

from rgbt.checks import InputError, check_shape
from rgbt.processes import mean_count
from rgbt.ranges import NonNegative
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import IGNORE, Batch, Loss, Output

ClassWeights = Annotated[tuple[NonNegative, ...], Len(1, 255)]


class CrossEntropy:
    """Mean over labelled pixels of ``-q c_y log softmax(s)_y``, divided by the mean of ``c_y``.

    q is the confidence of the label, 1 where labels carry none; it does not enter the mean that is
    divided by, so that labels of which the teacher is not sure cost little (HeatNet's release,
    weight_ir_sup). Pixels labelled 255 are left out; a batch without a labelled pixel
    costs 0.

    Args:
        class_weights: c, one value >= 0 per class; null weighs all classes alike.
    """

    record = Record(requires=(Requirement("model", "outputs", "scores"),), weighs_confidence=True)

    def __init__(self, *, class_weights: ClassWeights | None) -> None:
        self.class_weights = class_weights

    def __call__(
        self,
        output: Output,
        batch: Batch,
        generator: torch.Generator,  # noqa: ARG002 - what every loss is called with
    ) -> dict[str, Tensor]:
        """The part "cross_entropy": one value, shape (1,), float32.

        Of `logits` (B, K, H, W), `label` (B, H, W) and `confidence` (B, H, W) or None; nothing is
        drawn.

        Raises:
            InputError: class weights of another number.
            ValueError: label or confidence, and scores, of different size.
        """
        assert output.logits is not None, "the record requires scores"
        sizes = check_shape("logits", output.logits, "B K H W")
        check_shape("label", batch.label, "B H W", **{k: sizes[k] for k in "BHW"})
        weights = self._weights(sizes["K"], output.logits.device)
        logits = output.logits.float()
        if batch.confidence is None:
            total = F.cross_entropy(
                logits, batch.label, weights, ignore_index=IGNORE, reduction="sum"
            )
        else:
            check_shape("confidence", batch.confidence, "B H W", **{k: sizes[k] for k in "BHW"})
            costs = F.cross_entropy(
                logits, batch.label, weights, ignore_index=IGNORE, reduction="none"
            )
            total = (batch.confidence * costs).sum()
        # The smallest float only matters where nothing is labelled and the sum is 0.
        normaliser = mean_count(_sum_of_weights(batch.label, weights))
        normaliser = normaliser.clamp(min=torch.finfo(torch.float32).tiny)
        return {"cross_entropy": (total / normaliser).reshape(1)}

    def _weights(self, num_classes: int, device: torch.device) -> Tensor | None:
        if self.class_weights is None:
            return None
        if len(self.class_weights) != num_classes:
            raise InputError(
                f"loss.class_weights has {len(self.class_weights)} numbers, but the network has "
                f"{num_classes} classes; give one number per class."
            )
        return torch.tensor(self.class_weights, device=device)


def _sum_of_weights(label: Tensor, weights: Tensor | None) -> Tensor:
    """() float32: the sum of the class weights of the labelled pixels, or their number."""
    labelled = label != IGNORE
    if weights is None:  # without a wait for the number of pixels, as a selection has
        return labelled.sum().float()
    return weights[label[labelled]].sum()


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


def single(values: Tensor) -> Tensor:
    """At least float32: sums over millions of pixels are kept in it under autocast too."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
