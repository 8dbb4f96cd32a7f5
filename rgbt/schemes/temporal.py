"""A frame and a virtual view of it through shared weights, with losses on both and between them.

Source: Li, Chu, Sun, "Temporal Consistency for RGB-Thermal Data-based Semantic Scene
Understanding", Fig. 2 and Eq. 4, and its release.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.geometry.warp import Warp, halved_all, halved_mean
from rgbt.processes import own_draw
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import Batch, Frame, GeneratorOf, Output, Phase


class VirtualViews(Protocol):
    """What is called of a view, which draws the second frame (`rgbt.transforms.views`)."""

    def draw(self, count: int, generator: torch.Generator) -> Tensor: ...  # noqa: D102
    def warp(self, angles: Tensor, image_hw: tuple[int, int]) -> Warp: ...  # noqa: D102
    def batch(self, batch: Batch, warp: Warp) -> Batch: ...  # noqa: D102
    def valid(self, warp: Warp) -> Tensor: ...  # noqa: D102


@dataclass(kw_only=True, eq=False)
class Temporal:
    """Losses of a frame, of its virtual successor, and of the agreement of their predictions.

    Both frames go through the same weights. Where the network normalises over the batch they go
    one after the other, as released; else as one batch, which is the same function and faster.

    Paper: the first prediction ("segmentation map") is warped to the second frame; whether its
        gradient stops is left open.
    Released: scores are warped and normalised afterwards, and no gradient passes.

    Attributes:
        model: any network; one that returns masks of queries needs `dense_logits`.
        loss: loss of two frames (see `rgbt.losses.temporal.TemporalLoss`).
        view: draws virtual views and applies them.
        warps: "logits": scores are interpolated, then normalised; "probabilities": the reverse.
        detach: whether the first prediction is a fixed teacher of the second.
        resolution: of the loss between the predictions. "full" compares pixels. "half" is faster:
            it averages the scores of both frames over 2x2 pixels and compares these means. A
            mean counts where all of its pixels do. Paper and released: full.
    """

    model: nn.Module
    loss: Any
    view: VirtualViews
    warps: Literal["logits", "probabilities"]
    detach: bool
    resolution: Literal["full", "half"] = "full"

    def __post_init__(self) -> None:
        self.stacks = record_of(self.model).stacks_passes
        self.reads_warped = record_of(self.loss).reads_warped
        self.apart = any(isinstance(module, _BatchNorm) for module in self.model.modules())

    @property
    def record(self) -> Record:
        """A loss of two frames, whole images, and class scores of both."""
        makes_masks = record_of(self.model).outputs == "masks"
        half = Requirement("loss", "compares_half", True, "scheme.resolution=half")
        return Record(
            requires=(
                Requirement("loss", "frames", 2),
                Requirement("masker", "hides_cells", False),
                *((Requirement("model", "dense_logits", True),) if makes_masks else ()),
                *((half,) if self.resolution == "half" else ()),
                *(each.inside("scheme") for each in record_of(self.view).requires),
            ),
            frames=2,
            camera=record_of(self.view).camera,
        )

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """One phase with the parts of Eq. 4."""
        image_hw = (batch.rgb.shape[2], batch.rgb.shape[3])
        generator = generator_of("virtual view")
        angles = own_draw(lambda count: self.view.draw(count, generator), len(batch.name))
        warp = self.view.warp(angles, image_hw)
        first, second = self._frames(batch, self.view.batch(batch, warp), generator_of)
        valid = self.view.valid(warp)
        if self.resolution == "half":
            warp = warp.halved()
            # At odd sizes, the last half pixel may show a point outside where its pixels do not.
            valid = halved_all(valid) & self.view.valid(warp)
        warped = self._warped(first.logits, warp) if self.reads_warped else None
        parts = self.loss(first, second, warped, valid, generator_of("loss"))
        yield Phase(("main",), parts)

    def _warped(self, logits: Tensor, warp: Warp) -> Tensor:
        """Class probabilities of the first frame, as the second sees them."""
        scores = (logits.detach() if self.detach else logits).float()
        if self.resolution == "half":
            scores = halved_mean(scores)
        if self.warps == "probabilities":
            return warp.bilinear(scores.softmax(1))
        return warp.bilinear(scores).softmax(1)

    def _frames(
        self, first: Batch, second: Batch, generator_of: GeneratorOf
    ) -> tuple[Frame, Frame]:
        generator = generator_of("stochastic depth")
        if self.apart and not self.stacks:
            one, two = (self.model(x.rgb, x.thermal, generator=generator) for x in (first, second))
            return self._frame(one, first), self._frame(two, second)
        rgb = torch.cat([first.rgb, second.rgb])
        thermal = torch.cat([first.thermal, second.thermal])
        passes = {"passes": 2} if self.stacks else {}
        output = self.model(rgb, thermal, generator=generator, **passes)
        frames = []
        for number, batch in enumerate((first, second)):
            if self.stacks:  # (L, P = 2, B, ...)
                one_pass = slice(number, number + 1)
                own = Output(None, {k: v[:, one_pass] for k, v in output.aux.items()})
            else:  # scores, and what networks return beside, have the batch first
                part = slice(number * len(batch.name), (number + 1) * len(batch.name))
                own = Output(output.logits[part], {k: v[part] for k, v in output.aux.items()})
            frames.append(self._frame(own, batch))
        return frames[0], frames[1]

    def _frame(self, output: Output, batch: Batch) -> Frame:
        logits = output.logits
        if logits is None:  # masks of queries
            hw = (batch.rgb.shape[2], batch.rgb.shape[3])
            logits = cast(Tensor, cast(Any, self.model).dense_logits(output, hw))
        return Frame(output, batch, logits)
