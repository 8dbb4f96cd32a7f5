"""Complementary random masking with self-distillation, the six head passes as one batch.

Source: Shin et al., "Complementary Random Masking for RGB-Thermal Semantic Segmentation", and its
release; SpatialSeg trains with the same scheme and other masks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rgbt.losses.distances import sdc, sdn
from rgbt.ranges import NonNegative
from rgbt.requirements import Record, Requirement, record_of
from rgbt.schemes.domains import draw_masks
from rgbt.types import VIEWS, AnyMasker, Batch, GeneratorOf, Loss, MaskPair, Output, Phase


@dataclass(kw_only=True, eq=False)
class CRM:
    """Total loss ``L(F) + w_m (L(R) + L(T)) + L(F') + w_c SDC + w_n SDN``.

    F, R, T are the predictions of the clean pass from RGB-T, RGB alone and thermal alone; primes
    mark the masked pass. SDC is the mean absolute difference of the final class logits of F' to
    those of F, which are the fixed teacher; SDN the same for R' and T', summed.

    No loss reads the masks of R' and T', so the network does not predict them. With w_n = 0 nothing
    reads R' and T', and they are not predicted at all.

    With a masker that hides nothing there is no masked pass (the rows without masking of CRM
    Table 3a, which the release cannot run); the distillation weights must then be 0.

    Attributes:
        model: network with the arguments `passes`, `num_predictions` and `num_masks` of
            `rgbt.models.mask2former`.
        loss: criterion that returns one value per stacked pass.
        masker: draws the masks of the masked pass.
        modality_weight: w_m. 1 in the release.
        complementary_weight: w_c. 1 in the release.
        nonlocal_weight: w_n. 1 in the release.
    """

    model: nn.Module
    loss: Loss
    masker: AnyMasker
    modality_weight: NonNegative
    complementary_weight: NonNegative
    nonlocal_weight: NonNegative

    def __post_init__(self) -> None:
        self.hides_cells = record_of(self.masker).hides_cells
        # Single-modality predictions cost two thirds of the head: only where they are read.
        self.views = VIEWS if self.modality_weight or self.nonlocal_weight else VIEWS[:1]

    @property
    def record(self) -> Record:
        """A network of all views in one pass; where something is distilled, a masked pass."""
        weights = {
            "complementary_weight": self.complementary_weight,
            "nonlocal_weight": self.nonlocal_weight,
        }
        return Record(
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
        """One phase: the criterion of the supervised passes and the distillation terms."""
        # In a function of its own, so that the backward pass does not keep the mask logits.
        yield Phase(("main",), self._parts(batch, generator_of))

    def _parts(self, batch: Batch, generator_of: GeneratorOf) -> dict[str, Tensor]:
        """Weighted parts of the loss."""
        passes = 2 if self.hides_cells else 1
        # Stacked pass by pass, F R T F' R' T': the supervised ones are the first len(weights).
        modality = [self.modality_weight] * (len(self.views) - 1)
        weights = torch.tensor([1.0, *modality, *[1.0] * (passes - 1)]).to(batch.rgb.device)
        output = self._forward(batch, generator_of, supervised=len(weights))
        supervised = {name: tensor[:, : len(weights)] for name, tensor in output.aux.items()}
        parts = self.loss(Output(None, supervised), batch, generator_of("loss"))
        weighted = {name: (values * weights).sum() for name, values in parts.items()}
        if passes == 2:
            teacher, *others = output.aux["class_logits"][-1]
            student, *singles = others[len(self.views) - 1 :]
            if self.complementary_weight:
                weighted["sdc"] = self.complementary_weight * sdc(teacher, student)
            if self.nonlocal_weight:
                weighted["sdn"] = self.nonlocal_weight * sdn(teacher, *singles)
        return weighted

    def _forward(self, batch: Batch, generator_of: GeneratorOf, *, supervised: int) -> Output:
        """What the network returns; it has masks of the first `supervised` predictions alone."""
        generator = generator_of("stochastic depth")
        output: Output
        if not self.hides_cells:
            output = self.model(batch.rgb, batch.thermal, views=self.views, generator=generator)
            return output
        masks = draw_masks(self.masker, batch, generator_of("mask"))
        # SDN reads the class logits of R' and T'; without it, nothing reads them.
        distilled = len(self.views) - 1 if self.nonlocal_weight else 0
        output = self.model(
            batch.rgb.repeat(2, 1, 1, 1),
            batch.thermal.repeat(2, 1, 1, 1),
            MaskPair(*(torch.cat([torch.zeros_like(m), m]) for m in masks)),
            passes=2,
            views=self.views,
            num_predictions=supervised + distilled,
            num_masks=supervised,
            generator=generator,
        )
        return output
