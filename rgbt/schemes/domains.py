"""What schemes share: the masks of a batch, and the pass of a domain and its loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from rgbt.processes import own, whole
from rgbt.requirements import Requirement, SchemeRecord
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, MaskPair, Output, Phase, View

# The gradients with which the optimizers of two heads step their shared parameters.
#
#     apart      each with the gradient of its own domain
#     kept       the source's with its own, then the target's with both, the source's from before
#                that step (thesis' code, stage with labels on both domains: nothing is cleared)
#     together   both with the sum of both, one after the other (thesis' code, adversarial stage),
#                so that shared parameters are stepped twice
Gradients = Literal["apart", "kept", "together"]

WHOLE_IMAGES = Requirement("masker", "hides_cells", False)  # for schemes without a masked pass
SCORES = Requirement("model", "outputs", "scores")  # for schemes that read `scores`


class ViewAndHead(Protocol):
    """View and head of a domain (see `rgbt.data.domains.Domain`); None: the network's own."""

    @property
    def view(self) -> View | None: ...  # noqa: D102
    @property
    def head(self) -> str | None: ...  # noqa: D102


class SourceAndTarget(Protocol):
    """The domains of a run (see `rgbt.data.domains.Domains`): labelled, and to adapt to."""

    @property
    def source(self) -> ViewAndHead: ...  # noqa: D102
    @property
    def target(self) -> ViewAndHead | None: ...  # noqa: D102


def draw_masks(masker: AnyMasker, batch: Batch, generator: torch.Generator) -> MaskPair:
    """Draw hidden cells (B, h, w) for all processes; returns those of this one's samples."""
    height, width = batch.rgb.shape[-2:]
    masks = masker((height, width), whole(batch.centre_yx), generator)
    return MaskPair(*(own(mask) for mask in masks))


def options_of(domain: ViewAndHead) -> dict[str, Any]:
    """Return keyword arguments of the network for a domain, without those that are None."""
    given = {"views": domain.view and (domain.view,), "head": domain.head}
    return {name: value for name, value in given.items() if value is not None}


def scores(output: Output) -> Tensor:
    """Return the (B, K, H, W) class scores of an output."""
    assert output.logits is not None, "the record requires scores"
    return output.logits


class Passes:
    """Makes the passes of both domains through the network, and their losses.

    `optimizers` has the beginnings of parameters that each leaves out, by name. With a head for
    each domain, one optimiser per domain, which share all but the heads (thesis, Sec. III-B); else
    "main" for everything, and the gradients are "apart".
    """

    def __init__(
        self, model: nn.Module, loss: Loss, domains: SourceAndTarget, gradients: Gradients
    ) -> None:
        self.model, self.loss, self.gradients = model, loss, gradients
        self.source, self.target = domains.source, domains.target
        self.optimizers: dict[str, tuple[str, ...]] = {"main": ()}
        if self.target is not None and self.source.head != self.target.head:
            heads = {"source": self.source.head, "target": self.target.head}
            self.optimizers = {
                name: tuple(f"heads.{head}." for other, head in heads.items() if other != name)
                for name in heads
            }

    def record_with(
        self, *requires: Requirement, masked: Requirement = WHOLE_IMAGES, **provides: Any
    ) -> SchemeRecord:
        """Return the record of a scheme of two domains, with a `masked` masker."""
        heads = ("domains", "separate_heads", True, f"scheme.gradients={self.gradients}")
        return SchemeRecord(
            requires=(
                masked,
                Requirement("domains", "num_domains", 2),
                *((Requirement(*heads),) if self.gradients != "apart" else ()),
                *requires,
            ),
            num_domains=2,
            shows_views=True,
            optimizers=self.optimizers,
            **provides,
        )

    def output(
        self,
        name: str,
        batch: Batch,
        generator_of: GeneratorOf,
        masks: MaskPair | None = None,
        network: nn.Module | None = None,
    ) -> Output:
        """Return the output of the model, or of `network`, for a batch of "source" or "target"."""
        domain = self.source if name == "source" else self.target
        assert domain is not None, "a scheme of two domains has a target"
        # A pass with masks has draws of its own.
        generator = generator_of(f"{name} network" + (" masked" if masks else ""))
        network = self.model if network is None else network
        return network(batch.rgb, batch.thermal, masks, generator=generator, **options_of(domain))

    def supervised(
        self, name: str, batch: Batch, generator_of: GeneratorOf
    ) -> tuple[Output, dict[str, Tensor]]:
        """Return the output, and weighted parts of the loss named ``<domain>/<part>``."""
        output = self.output(name, batch, generator_of)
        parts = self.loss(output, batch, generator_of(f"{name} loss"))
        return output, {f"{name}/{part}": values.sum() for part, values in parts.items()}

    def phases(self, cost: Callable[[str], dict[str, Tensor]]) -> Iterator[Phase]:
        """Yield the phases of a step with the costs of "source" and then of "target"."""
        if len(self.optimizers) == 1 or self.gradients == "together":
            yield Phase(tuple(self.optimizers), cost("source") | cost("target"))
            return
        yield Phase(("source",), cost("source"))
        yield Phase(("target",), cost("target"), clear=self.gradients == "apart")
