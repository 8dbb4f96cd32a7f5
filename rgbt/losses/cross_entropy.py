"""Pixel-wise cross-entropy for networks that return dense class scores, and auxiliary ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Literal

import numpy as np
import torch
from annotated_types import Len
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rgbt.processes import mean_count
from rgbt.ranges import NonNegative
from rgbt.requirements import LossRecord, Requirement, record_of
from rgbt.types import IGNORE, Batch, Loss, Output

ClassWeights = Annotated[tuple[NonNegative, ...], Len(1, 255)]

Computed = Literal["enet", "median_frequency", "inverse"]
# Returns the pixels of each class in each label of the training split, (N, K).
ClassPixels = Callable[[], NDArray[np.int64]]

TINY = torch.finfo(torch.float32).tiny  # divisor where nothing counts, of a sum that is 0


class CrossEntropy:
    """Averages ``-q c_y log softmax(s)_y`` over labelled pixels, divided by the mean of ``c_y``.

    q is the confidence of the label, 1 where labels carry none; it does not enter the mean that is
    divided by, so that labels of which the teacher is not sure cost little (HeatNet's release,
    weight_ir_sup). Pixels labelled 255 are left out; a batch without a labelled pixel costs 0.
    `class_weights` are c, one value per class, or how they are computed from the training split
    (`weights_from`); None weighs all classes alike.
    """

    weighs_confidence = True

    def __init__(
        self,
        *,
        class_weights: ClassWeights | Computed | None,
        class_pixels: ClassPixels | None = None,
    ) -> None:
        required = [Requirement("model", "outputs", "scores")]
        if isinstance(class_weights, str):
            assert class_pixels is not None, "a run provides the pixels of its training split"
            class_weights = weights_from(class_pixels(), class_weights)
        elif class_weights is not None:
            setting = f"loss.class_weights={list(class_weights)}"
            required.append(Requirement("dataset", "num_classes", len(class_weights), setting))
        self.class_weights = class_weights
        self.record = LossRecord(requires=tuple(required), weighs_confidence=self.weighs_confidence)

    def __call__(
        self,
        output: Output,
        batch: Batch,
        generator: torch.Generator,  # noqa: ARG002 - what every loss is called with
    ) -> dict[str, Tensor]:
        """Return the part "cross_entropy": one value, shape (1,), float32.

        Of `logits` (B, K, H, W), `label` (B, H, W) and `confidence` (B, H, W) or None.
        """
        assert output.logits is not None, "the record requires scores"
        weights, label = None, batch.label
        labelled = label != IGNORE
        count = labelled.sum().float()
        if self.class_weights is not None:
            weights = torch.tensor(self.class_weights, device=label.device)
            count = weights[label[labelled]].sum()
        # Reduced by torch where it can, because a map of costs takes memory and time.
        reduction = "sum" if batch.confidence is None else "none"
        total = F.cross_entropy(
            output.logits.float(), label, weights, ignore_index=IGNORE, reduction=reduction
        )
        if batch.confidence is not None:
            total = (batch.confidence * total).sum()
        return {"cross_entropy": (total / mean_count(count).clamp(min=TINY)).reshape(1)}


def weights_from(pixels: NDArray[np.int64], kind: Computed) -> tuple[float, ...]:
    """Compute a weight of each class from its pixels in labels (N, K); 0 if it never occurs.

        enet              1 / ln(1.02 + p_c), p_c the share of all pixels
        median_frequency  median(f) / f_c, f_c the share of the pixels of labels that show c; the
                          median is that of the classes that occur
        inverse           1 / (K p_c)

    Source: ENet (Paszke et al., 2016), Sec. 5.2, c = 1.02; Eigen and Fergus (ICCV 2015), semantic
    labels; the last is the inverse frequency that gives all classes the same sum.
    """
    total = pixels.sum(0)
    share = total / max(total.sum(), 1)
    if kind == "enet":
        weights = 1 / np.log(1.02 + share)
    elif kind == "inverse":
        weights = 1 / np.maximum(len(share) * share, TINY)
    else:
        where = ((pixels > 0) * pixels.sum(1, keepdims=True)).sum(0)
        frequency = total / np.maximum(where, 1)
        weights = np.median(frequency[total > 0]) / np.maximum(frequency, TINY)
    return tuple(np.where(total > 0, weights, 0.0).tolist())


@dataclass(frozen=True, kw_only=True)
class WithAuxiliary:
    """Adds to a loss of the class scores ``weight`` times the same loss of the auxiliary ones.

    Source: PSPNet (0.4); AdaptSegNet, Eq. 5, and MaxSquareLoss (0.1); thesis (J. Sun), code (0.1
    with maximum squares).
    """

    loss: Loss
    weight: NonNegative

    @property
    def record(self) -> LossRecord:
        """Require what `loss` requires, and a network with an auxiliary head."""
        record = record_of(self.loss, LossRecord)
        auxiliary = Requirement("model", "auxiliary", True)
        return replace(record, requires=(*record.requires, auxiliary), reads_auxiliary=True)

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Return the parts of `loss`, and weighted those of `aux["aux_logits"]` as <part>_aux."""
        parts = dict(self.loss(output, batch, generator))
        auxiliary = self.loss(Output(output.aux["aux_logits"], {}), batch, generator)
        for name, part in auxiliary.items():
            parts[f"{name}_aux"] = self.weight * part
        return parts


def single(values: Tensor) -> Tensor:
    """Convert to float32 at least, so that autocast does not sum millions of pixels in less."""
    return values.to(torch.promote_types(values.dtype, torch.float32))
