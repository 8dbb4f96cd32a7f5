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
from rgbt.requirements import Record, Requirement, record_of
from rgbt.schemes.domains import Gradients, Passes, SourceAndTarget, scores
from rgbt.types import GeneratorOf, Loss, Phase, TwoDomains

DomainValue = Annotated[float, Interval(ge=-10, le=10)]
"""Verdicts and the number they should be -> scalar (see `rgbt.losses.unlabelled`)."""

CRITIC = "critic"


@dataclass(kw_only=True, eq=False)
class Adversarial:
    """A segmentation phase and a discriminator phase, in every step or in alternating steps.

        segmentation    L_s(source) [+ L_s(target)] + weight w A
        discriminator   C = d(D(source), y_s) + d(D(target), y_t), halved on request

    with D the discriminator, d the verdict loss, y_s and y_t the domains' numbers, and

        A = d(D(target), y_s) [+ d(D(source), y_t) with `both_ways`]

    w is 1, or the mean over pixels of 1 - c, c being the confidence of the target's labels.

    Source: thesis (J. Sun), Eqs. 4 to 6; HeatNet, Sec. III; AdaptSegNet, Eqs. 1 to 3; ADVENT.

    Attributes:
        model: the network.
        loss: L_s, of one domain.
        domains: source and target.
        critic: D (see `rgbt.models.critic.Critic`).
        critic_optimizer: builder of its optimiser, named "critic" in phases.
        judged: input of the discriminator: class probabilities (thesis, AdaptSegNet), raw
            scores (HeatNet), or weighted self-information (ADVENT).
        verdict_loss: d: "least_squares" (thesis, HeatNet), or "cross_entropy" with logits
            (AdaptSegNet, ADVENT).
        source_value: y_s. Thesis, AdaptSegNet, ADVENT: 0; HeatNet: 1.
        target_value: y_t. The other one.
        weight: of A. Thesis' code and HeatNet's best command: 0.01; AdaptSegNet, ADVENT: 0.001.
        both_ways: whether the source is also trained to be classified as the target (HeatNet).
        weighed_by_confidence: whether w is not 1 (HeatNet); needs labels with confidence.
        halved: whether C is halved (AdaptSegNet, ADVENT).
        supervise_target: whether L_s of the target is computed. Thesis, Eq. 4: no; the code of its
            basic network and HeatNet: yes.
        alternates: whether steps alternate between the two phases, the discriminator's first
            (HeatNet); false: both in every step.
        gradients: see `rgbt.schemes.domains.Gradients`. Released (thesis): "together"; the code of
            its basic network: "kept".
        idle_steps: what the optimiser of one phase does in a step of the other, where the steps
            alternate. "none": nothing. "released" (HeatNet, thesis' port): it steps with gradients
            of 0, because the release has one optimiser for both networks and torch 1.7. For
            RMSprop this halves the memory of the mean of squared gradients; with a constant
            gradient every step is sqrt(1 + alpha) = 1.41 times as long.

    Raises:
        InputError: numbers that the verdict loss does not take, idle steps without alternation.
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
        values = {"source": self.source_value, "target": self.target_value}
        setting = f"scheme.source_value={self.source_value:g}, target_value={self.target_value:g}"
        if self.source_value == self.target_value:
            raise InputError(f"{setting}: the discriminator requires two different numbers.")
        if self.verdict_loss == "cross_entropy" and not all(0 <= v <= 1 for v in values.values()):
            raise InputError(f"{setting}: cross_entropy requires numbers between 0 and 1.")
        if self.idle_steps == "released" and not self.alternates:
            raise InputError("scheme.idle_steps=released requires scheme.alternates=true.")
        self.passes = Passes(
            model=self.model, loss=self.loss, domains=self.domains, gradients=self.gradients
        )
        # Fabric's wrapper takes the place of the network here.
        self.others: dict[str, nn.Module] = {CRITIC: self.critic}
        self.cost_of = VERDICT_LOSSES[self.verdict_loss]
        self.values = values

    @property
    def record(self) -> Record:
        """Labels of the target where they are read, confidence where it weighs."""
        labels = self.supervise_target
        setting = f"scheme.supervise_target={str(labels).lower()}"
        required = [Requirement("domains", "target_labels", labels, setting)]
        if self.weighed_by_confidence:
            setting = "scheme.weighed_by_confidence=true"
            required.append(Requirement("domains", "target_confidence", True, setting))
        return self.passes.record_with(
            *required,
            *record_of(self.others[CRITIC]).requires,
            networks=self.others,
            builders={CRITIC: self.critic_optimizer},
        )

    def phases(self, batch: TwoDomains, generator_of: GeneratorOf) -> Iterator[Phase]:
        """The segmentation's phases, then the discriminator's; or one of both kinds."""
        seen: dict[str, Tensor] = {}
        released = self.idle_steps == "released"
        if self.alternates and batch.step % 2 == 0:
            with torch.no_grad():
                for name, each in (("source", batch.source), ("target", batch.target)):
                    output = self.passes.output(name, each, generator_of)
                    seen[name] = judged_map(scores(output), self.judged)
            idle = tuple(self.passes.optimizers) if released else ()
            yield self._discriminator_phase(seen)._replace(idle=idle)
            return
        self.others[CRITIC].requires_grad_(False)
        phases = self.passes.phases(
            lambda: self._domain("source", batch, generator_of, seen),
            lambda: self._domain("target", batch, generator_of, seen),
        )
        idle = (CRITIC,) if released else ()
        for number, phase in enumerate(phases):  # one step of the discriminator's optimiser
            yield phase._replace(idle=() if number else idle)
        self.others[CRITIC].requires_grad_(True)
        if not self.alternates:
            yield self._discriminator_phase({name: each.detach() for name, each in seen.items()})

    def _domain(
        self, name: str, batch: TwoDomains, generator_of: GeneratorOf, seen: dict[str, Tensor]
    ) -> dict[str, Tensor]:
        """Loss parts of a domain; the input of the discriminator is appended to `seen`."""
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
        costs = {name: self.cost_of(critic(each), self.values[name]) for name, each in seen.items()}
        return Phase((CRITIC,), {f"{CRITIC}/{name}": share * cost for name, cost in costs.items()})
