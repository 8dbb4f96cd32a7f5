"""Adversarial adaptation with a discriminator that predicts the domain of the predictions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from annotated_types import Interval
from torch import Tensor, nn

from rgbt.checks import InputError
from rgbt.losses.unlabelled import VERDICT_LOSSES, Judged
from rgbt.losses.unlabelled import judged as judged_map
from rgbt.processes import mean_count
from rgbt.ranges import NonNegative
from rgbt.requirements import Record, Requirement, SchemeRecord, record_of
from rgbt.schemes.domains import SCORES, Gradients, Passes, SourceAndTarget, scores
from rgbt.types import GeneratorOf, Loss, Phase, TwoDomains

DomainValue = Annotated[float, Interval(ge=-10, le=10)]
CRITIC = "critic"


@dataclass(kw_only=True, eq=False)
class Adversarial:
    """Trains segmentation and discriminator, in every step or in alternating steps.

        segmentation    L_s(source) [+ L_s(target)] + weight w A
        discriminator   C = d(D(source), y_s) + d(D(target), y_t), halved on request

    with L_s the loss of one domain, D the discriminator (`critic`), d the verdict loss, y_s and y_t
    the numbers of the domains, and

        A = d(D(target), y_s) [+ d(D(source), y_t) with `both_ways`]

    w is 1, or the mean over pixels of 1 - c, c being the confidence of the target's labels. The
    settings are the keys of ``conf/scheme/adversarial_heatnet.yaml``.

    Source: thesis (J. Sun), Eqs. 4 to 6; HeatNet, Sec. III; AdaptSegNet, Eqs. 1 to 3; ADVENT.
    Released, HeatNet and the thesis' port: one optimiser for both networks, with torch 1.7, which
    also steps the network of the other phase with gradients of 0 (`idle_steps`). RMSprop's mean of
    squares then decays, and every step is sqrt(1 + alpha) = 1.41 times as long.
    """

    model: nn.Module
    loss: Loss
    domains: SourceAndTarget
    critic: nn.Module
    critic_optimizer: Callable[..., torch.optim.Optimizer]
    judged: Judged
    verdict_loss: Literal["least_squares", "cross_entropy"]
    source_value: DomainValue
    target_value: DomainValue
    weight: NonNegative
    both_ways: bool
    weighed_by_confidence: bool
    halved: bool
    supervise_target: bool
    alternates: bool
    gradients: Gradients
    idle_steps: Literal["none", "released"] = "none"

    def __post_init__(self) -> None:
        self.values = values = {"source": self.source_value, "target": self.target_value}
        setting = f"scheme.source_value={self.source_value:g}, target_value={self.target_value:g}"
        if self.source_value == self.target_value:
            raise InputError(f"{setting}: the discriminator requires two different numbers.")
        if self.verdict_loss == "cross_entropy" and not all(0 <= v <= 1 for v in values.values()):
            raise InputError(f"{setting}: cross_entropy requires numbers between 0 and 1.")
        if self.idle_steps == "released" and not self.alternates:
            raise InputError("scheme.idle_steps=released requires scheme.alternates=true.")
        self.passes = Passes(self.model, self.loss, self.domains, self.gradients)
        # Fabric's wrapper takes the place of the network here.
        self.others: dict[str, nn.Module] = {CRITIC: self.critic}
        self.cost_of = VERDICT_LOSSES[self.verdict_loss]

    @property
    def record(self) -> SchemeRecord:
        """Require labels of the target where they are read, confidence where it weighs."""
        labels = self.supervise_target
        setting = f"scheme.supervise_target={str(labels).lower()}"
        weighed = ("domains", "target_confidence", True, "scheme.weighed_by_confidence=true")
        return self.passes.record_with(
            SCORES,
            Requirement("domains", "target_labels", labels, setting),
            *((Requirement(*weighed),) if self.weighed_by_confidence else ()),
            *record_of(self.others[CRITIC], Record).requires,
            networks=self.others,
            builders={CRITIC: self.critic_optimizer},
        )

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield the segmentation's phases, then the discriminator's; or one of both kinds."""
        seen: dict[str, Tensor] = {}
        released = self.idle_steps == "released"
        if self.alternates and batch.step % 2 == 0:
            with torch.no_grad():
                for name, images in (("source", batch.source), ("target", batch.target)):
                    output = self.passes.output(name, images, generator_of)
                    seen[name] = judged_map(scores(output), self.judged)
            idle = tuple(self.passes.optimizers) if released else ()
            yield self._discriminator_phase(seen)._replace(idle=idle)
            return
        self.others[CRITIC].requires_grad_(False)
        phases = self.passes.phases(lambda name: self._domain(name, batch, generator_of, seen))
        idle = (CRITIC,) if released else ()
        for number, phase in enumerate(phases):  # one step of the discriminator's optimiser
            yield phase._replace(idle=() if number else idle)
        self.others[CRITIC].requires_grad_(True)
        if not self.alternates:
            yield self._discriminator_phase({name: seen[name].detach() for name in seen})

    def _domain(
        self, name: str, batch: TwoDomains, generator_of: GeneratorOf, seen: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Compute loss parts of a domain, and add the input of the discriminator to `seen`."""
        is_source = name == "source"
        own = batch.source if is_source else batch.target
        parts: dict[str, Tensor] = {}
        if is_source or self.supervise_target:
            output, parts = self.passes.supervised(name, own, generator_of)
        else:
            output = self.passes.output(name, own, generator_of)
        seen[name] = judged_map(scores(output), self.judged)
        if self.both_ways or not is_source:
            verdicts = self.others[CRITIC](seen[name])
            cost = self.cost_of(verdicts, self.values["target" if is_source else "source"])
            if self.weighed_by_confidence:
                confidence = batch.target.confidence
                assert confidence is not None, "the record requires it"
                # A factor of a cost that is averaged over the processes: that of all samples.
                cost = cost * mean_count((1.0 - confidence).mean())
            parts[f"{name}/adversarial"] = self.weight * cost
        return parts

    def _discriminator_phase(self, seen: Mapping[str, Tensor]) -> Phase:
        share = 0.5 if self.halved else 1.0
        critic = self.others[CRITIC]
        parts = {}
        for name, maps in seen.items():
            parts[f"{CRITIC}/{name}"] = share * self.cost_of(critic(maps), self.values[name])
        return Phase((CRITIC,), parts)
