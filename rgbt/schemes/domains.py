"""What schemes share: the masks of a batch, and the pass of a domain and its loss."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, Literal, Protocol

import torch
from torch import Tensor, nn

from rgbt.processes import own, whole
from rgbt.requirements import Record, Requirement
from rgbt.types import AnyMasker, Batch, GeneratorOf, Loss, MaskPair, Output, Phase, View

Gradients = Literal["apart", "kept", "together"]
"""The gradients with which the optimizers of two heads step their shared parameters.

    apart      each with the gradient of its own domain
    kept       the source's with its own, then the target's with both, the source's from before
               that step (thesis' code, stage with labels on both domains: nothing is cleared)
    together   both with the sum of both, one after the other (thesis' code, adversarial stage),
               so that shared parameters are stepped twice

Where gradients are clipped (published: they are not), with "kept" the target's is added to what the
source's was clipped to.
"""


class ViewAndHead(Protocol):
    """View and head of a domain (see `rgbt.data.domains.Domain`); None: the network's own."""

    @property
    def view(self) -> View | None: ...  # noqa: D102
    @property
    def head(self) -> str | None: ...  # noqa: D102


def draw_masks(masker: AnyMasker, batch: Batch, generator: torch.Generator) -> MaskPair:
    """Hidden cells of the samples of this process, (B, h, w) bool each.

    The masker draws for the samples of all processes, so that it needs to know nothing of them.
    """
    height, width = batch.rgb.shape[-2:]
    masks = masker((height, width), whole(batch.centre_yx), generator)
    return MaskPair(*(own(mask) for mask in masks))


def options_of(domain: ViewAndHead) -> dict[str, Any]:
    """Keyword arguments of the network for a domain, without those that are None."""
    given = {"views": domain.view and (domain.view,), "head": domain.head}
    return {name: value for name, value in given.items() if value is not None}


class SourceAndTarget(Protocol):
    """The domains of a run (see `rgbt.data.domains.Domains`): labelled, and to adapt to."""

    @property
    def source(self) -> ViewAndHead: ...  # noqa: D102
    @property
    def target(self) -> ViewAndHead | None: ...  # noqa: D102


WHOLE_IMAGES = Requirement("masker", "hides_cells", False)
"""Of a scheme without a masked pass."""


class Passes:
    """The passes of both domains through the network, and their losses.

    Args:
        model: the network.
        loss: of one domain's scores and labels.
        domains: source and target.
        gradients: see `Gradients`; "apart" where there is one optimiser.

    Attributes:
        optimizers: name -> beginnings of the names of parameters that it leaves out. With a head
            for each domain, one optimiser per domain, which share all but the heads (thesis,
            Sec. III-B); else "main" for everything.
    """

    def __init__(
        self, *, model: nn.Module, loss: Loss, domains: SourceAndTarget, gradients: Gradients
    ) -> None:
        self.model = model
        self.loss = loss
        self.source = domains.source
        self.target = domains.target
        self.optimizers: dict[str, tuple[str, ...]] = {"main": ()}
        if self.target is not None and self.source.head != self.target.head:
            heads = {"source": self.source.head, "target": self.target.head}
            self.optimizers = {
                name: tuple(f"heads.{head}." for other, head in heads.items() if other != name)
                for name in heads
            }
        self.gradients = gradients

    def record_with(
        self, *requires: Requirement, masked: Requirement = WHOLE_IMAGES, **provides: Any
    ) -> Record:
        """Of a scheme of two domains and class scores, with what else it says.

        `masked` is the requirement of the masker.
        """
        of_heads = Requirement(
            "domains", "separate_heads", True, f"scheme.gradients={self.gradients}"
        )
        return Record(
            requires=(
                Requirement("model", "outputs", "scores"),
                masked,
                Requirement("domains", "num_domains", 2),
                *((of_heads,) if self.gradients != "apart" else ()),
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
        """The output for a batch of the domain "source" or "target", of `network` or of the own.

        A pass with `masks` has draws of its own.
        """
        domain = self.source if name == "source" else self.target
        assert domain is not None, "a scheme of two domains has a target"
        generator = generator_of(f"{name} network" + (" masked" if masks else ""))
        network = self.model if network is None else network
        output: Output = network(
            batch.rgb, batch.thermal, masks, generator=generator, **options_of(domain)
        )
        return output

    def supervised(
        self, name: str, batch: Batch, generator_of: GeneratorOf
    ) -> tuple[Output, dict[str, Tensor]]:
        """The output, and weighted parts of the loss named ``<domain>/<part>``."""
        output = self.output(name, batch, generator_of)
        parts = self.loss(output, batch, generator_of(f"{name} loss"))
        return output, {f"{name}/{part}": values.sum() for part, values in parts.items()}

    def phases(
        self, source: Callable[[], dict[str, Tensor]], target: Callable[[], dict[str, Tensor]]
    ) -> Iterator[Phase]:
        """A step in which the two domains cost what `source` and then `target` compute.

        With one optimiser both are one backward pass; with two, see `Gradients`.
        """
        if len(self.optimizers) == 1 or self.gradients == "together":
            yield Phase(tuple(self.optimizers), source() | target())
            return
        yield Phase(("source",), source())
        yield Phase(("target",), target(), clear=self.gradients == "apart")


def scores(output: Output) -> Tensor:
    """(B, K, H, W) class scores of an output."""
    assert output.logits is not None, "the record requires scores"
    return output.logits
