"""Schemes for two domains: labels on both, or a loss without labels on the target."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.losses.unlabelled import guidance
from rgbt.processes import mean_count, num_processes
from rgbt.ranges import NonNegative, Share
from rgbt.requirements import Requirement, SchemeRecord
from rgbt.schemes.domains import SCORES, Gradients, Passes, SourceAndTarget, scores
from rgbt.types import IGNORE, GeneratorOf, Loss, Phase, TwoDomains


@dataclass(kw_only=True, eq=False)
class LabelledDomains:
    """Trains segmentation of both domains with labels; `loss` is that of one domain.

    Source: thesis (J. Sun), Sec. III-B, first stage; also HeatNet's students and first stage.
    Released (thesis): the gradients "kept".
    """

    model: nn.Module
    loss: Loss
    domains: SourceAndTarget
    gradients: Gradients

    def __post_init__(self) -> None:
        self.passes = Passes(**vars(self))

    @property
    def record(self) -> SchemeRecord:
        """Require labels of the target, beside what two domains require."""
        return self.passes.record_with(Requirement("domains", "target_labels", True))

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase, or one per optimiser."""
        batches = {"source": batch.source, "target": batch.target}
        yield from self.passes.phases(
            lambda name: self.passes.supervised(name, batches[name], generator_of)[1]
        )


@dataclass(kw_only=True, eq=False)
class UnlabelledTarget:
    """Trains segmentation of the source, and a loss without labels on the target.

    `unlabelled` maps the probabilities (B, K, H, W) of the target to named, weighted scalars; the
    auxiliary head may also be trained with the guidance of both heads (`guidance`).

    Source: MaxSquareLoss; ADVENT (direct entropy minimisation); thesis (J. Sun), Sec. III-A.
    """

    model: nn.Module
    loss: Loss
    domains: SourceAndTarget
    unlabelled: Callable[[Tensor], dict[str, Tensor]]
    guidance_weight: NonNegative
    guidance_threshold: Share

    def __post_init__(self) -> None:
        self.passes = Passes(self.model, self.loss, self.domains, "apart")

    @property
    def record(self) -> SchemeRecord:
        """Require no labels of the target; for guidance, an auxiliary head."""
        setting = f"scheme.guidance_weight={self.guidance_weight:g}"
        guided = (Requirement("model", "auxiliary", True, setting),) if self.guidance_weight else ()
        unlabelled = Requirement("domains", "target_labels", False)
        return self.passes.record_with(SCORES, unlabelled, *guided)

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase, or one per optimiser."""
        yield from self.passes.phases(lambda name: self._cost(name, batch, generator_of))

    def _cost(self, name: str, batch: TwoDomains, generator_of: GeneratorOf) -> dict[str, Tensor]:
        if name == "source":
            return self.passes.supervised("source", batch.source, generator_of)[1]
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
