"""Schemes for two domains: labels on both, or a loss without labels on the target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.losses.unlabelled import guidance
from rgbt.processes import mean_count, num_processes
from rgbt.ranges import NonNegative, Share
from rgbt.requirements import Record, Requirement
from rgbt.schemes.domains import Gradients, Passes, SourceAndTarget, scores
from rgbt.types import IGNORE, GeneratorOf, Loss, Phase, TwoDomains

UnlabelledLoss = Callable[[Tensor], dict[str, Tensor]]
"""(B, K, H, W) probabilities -> named, weighted scalars (see `rgbt.losses.unlabelled`)."""


@dataclass(kw_only=True, eq=False)
class LabelledDomains:
    """Segmentation of both domains with the labels of each.

    Source: thesis (J. Sun), Sec. III-B, first stage; also HeatNet's students and first stage.

    Attributes:
        model: the network.
        loss: of one domain.
        domains: source and target, both with labels.
        gradients: see `rgbt.schemes.domains.Gradients`. Released (thesis): "kept".
    """

    model: nn.Module
    loss: Loss
    domains: SourceAndTarget
    gradients: Gradients

    def __post_init__(self) -> None:
        self.passes = Passes(**vars(self))

    @property
    def record(self) -> Record:
        """Labels of the target, beside what two domains require."""
        return self.passes.record_with(Requirement("domains", "target_labels", True))

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase, or one per optimiser."""
        yield from self.passes.phases(
            lambda: self.passes.supervised("source", batch.source, generator_of)[1],
            lambda: self.passes.supervised("target", batch.target, generator_of)[1],
        )


@dataclass(kw_only=True, eq=False)
class UnlabelledTarget:
    """Segmentation of the source, and a loss without labels on the target.

    Source: MaxSquareLoss; ADVENT (direct entropy minimisation); thesis (J. Sun), Sec. III-A.

    Attributes:
        model: the network.
        loss: of the source.
        domains: a labelled source and a target whose labels are "none".
        unlabelled: loss of the target's probabilities (`rgbt.losses.unlabelled`).
        guidance_weight: of the cross-entropy of the auxiliary head with the guidance of both heads
            (`rgbt.losses.unlabelled.guidance`); 0 for none. Released: 0.01, the product of 0.1 and
            0.1.
        guidance_threshold: probability above which a head is sure. Released: 0.95.
    """

    model: nn.Module
    loss: Loss
    domains: SourceAndTarget
    unlabelled: UnlabelledLoss
    guidance_weight: NonNegative
    guidance_threshold: Share

    def __post_init__(self) -> None:
        self.passes = Passes(
            model=self.model, loss=self.loss, domains=self.domains, gradients="apart"
        )

    @property
    def record(self) -> Record:
        """No labels of the target; for guidance, an auxiliary head."""
        setting = f"scheme.guidance_weight={self.guidance_weight:g}"
        guided = (Requirement("model", "auxiliary", True, setting),) if self.guidance_weight else ()
        return self.passes.record_with(Requirement("domains", "target_labels", False), *guided)

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase, or one per optimiser; see `LabelledDomains.phases`."""
        yield from self.passes.phases(
            lambda: self.passes.supervised("source", batch.source, generator_of)[1],
            lambda: self._target(batch, generator_of),
        )

    def _target(self, batch: TwoDomains, generator_of: GeneratorOf) -> dict[str, Tensor]:
        output = self.passes.output("target", batch.target, generator_of)
        probabilities = scores(output).float().softmax(1)
        parts = dict(self.unlabelled(probabilities))
        if self.guidance_weight:
            auxiliary = output.aux["aux_logits"].float()
            label = guidance(probabilities, auxiliary.softmax(1), self.guidance_threshold)
            total = F.cross_entropy(auxiliary, label, ignore_index=IGNORE, reduction="sum")
            # Where neither head is sure anywhere, the sum is 0 and so is the cost.
            count = mean_count((label != IGNORE).sum())
            cost = total / count.clamp(min=1 / num_processes())
            parts["guidance"] = self.guidance_weight * cost
        return {f"target/{name}": value for name, value in parts.items()}
