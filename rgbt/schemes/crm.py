"""Complementary random masking with self-distillation, the six head passes as one batch.

Source: Shin et al., "Complementary Random Masking for RGB-Thermal Semantic Segmentation", and its
release; SpatialSeg trains with the same scheme and other masks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from rgbt.losses.distances import sdc, sdn
from rgbt.ranges import NonNegative
from rgbt.requirements import MaskerRecord, Requirement, SchemeRecord, record_of
from rgbt.schemes.domains import draw_masks
from rgbt.types import VIEWS, AnyMasker, Batch, GeneratorOf, Loss, MaskPair, Output, Phase


@dataclass(kw_only=True, eq=False)
class CRM:
    """Total loss ``L(F) + w_m (L(R) + L(T)) + L(F') + w_c SDC + w_n SDN``.

    F, R, T are the predictions of the clean pass from RGB-T, RGB alone and thermal alone; primes
    mark the masked pass. SDC is the mean absolute difference of the final class logits of F' to
    those of F, which are the fixed teacher; SDN the same for R' and T', summed. The weights are
    those of the modality, the complementary and the nonlocal term, 1 in the release.

    No loss reads the masks of R' and T', so the network does not predict them. With w_n = 0 nothing
    reads R' and T', and they are not predicted at all.

    With a masker that hides nothing there is no masked pass (the rows without masking of CRM
    Table 3a, which the release cannot run); the distillation weights must then be 0.

    The loss returns one value per stacked pass.
    """

    model: nn.Module
    loss: Loss
    masker: AnyMasker
    modality_weight: NonNegative
    complementary_weight: NonNegative
    nonlocal_weight: NonNegative

    def __post_init__(self) -> None:
        self.hides_cells = record_of(self.masker, MaskerRecord).hides_cells
        # Single-modality predictions cost two thirds of the head: only where they are read.
        self.views = VIEWS if self.modality_weight or self.nonlocal_weight else VIEWS[:1]

    @property
    def record(self) -> SchemeRecord:
        """Require all views in one pass; where something is distilled, a masked pass."""
        distilled = ("complementary_weight", "nonlocal_weight")
        weights = {name: getattr(self, name) for name in distilled}
        return SchemeRecord(
            requires=(
                Requirement("model", "views", VIEWS),
                Requirement("model", "stacks_passes", True),
                *(
                    Requirement("masker", "hides_cells", True, f"scheme.{name}={weight:g}")
                    for name, weight in weights.items()
                    if weight
                ),
            )
        )

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase: the losses of the supervised passes and the distillation terms."""
        # This is a function of its own, so that the backward pass does not keep the mask logits.
        yield Phase(("main",), self._parts(batch, generator_of))

    def _parts(self, batch: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        """Compute weighted loss parts, from passes stacked in the order F R T F' R' T'."""
        modality = [self.modality_weight] * (len(self.views) - 1)
        weights = torch.tensor([1.0, *modality, *[1.0] * self.hides_cells]).to(batch.rgb.device)
        supervised = len(weights)  # the first ones
        generator, masks = generator_of("stochastic depth"), None
        images, stacked = (batch.rgb, batch.thermal), dict[str, Any]()
        if self.hides_cells:
            masks = draw_masks(self.masker, batch, generator_of("mask"))
            masks = MaskPair(*(torch.cat([torch.zeros_like(m), m]) for m in masks))
            images = (batch.rgb.repeat(2, 1, 1, 1), batch.thermal.repeat(2, 1, 1, 1))
            # SDN reads the class logits of R' and T'; without it, nothing reads them.
            others = len(self.views) - 1 if self.nonlocal_weight else 0
            stacked = {"passes": 2, "num_predictions": supervised + others, "num_masks": supervised}
        output = self.model(*images, masks, views=self.views, generator=generator, **stacked)
        read = {name: tensor[:, :supervised] for name, tensor in output.aux.items()}
        parts = self.loss(Output(None, read), batch, generator_of("loss"))
        weighted = {name: (values * weights).sum() for name, values in parts.items()}
        if self.hides_cells:
            teacher, *others = output.aux["class_logits"][-1]
            student, *singles = others[len(self.views) - 1 :]
            if self.complementary_weight:
                weighted["sdc"] = self.complementary_weight * sdc(teacher, student)
            if self.nonlocal_weight:
                weighted["sdn"] = self.nonlocal_weight * sdn(teacher, *singles)
        return weighted
