"""A frame and a virtual view of it through shared weights, with losses on both and between them.

Source: Li, Chu, Sun, "Temporal Consistency for RGB-Thermal Data-based Semantic Scene
Understanding", Fig. 2 and Eq. 4, and its release.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from rgbt.geometry.warp import Warp, halved_all, halved_mean
from rgbt.processes import own_draw
from rgbt.requirements import (
    LossRecord,
    NetworkRecord,
    Record,
    Requirement,
    SchemeRecord,
    record_of,
)
from rgbt.types import Batch, Frame, GeneratorOf, Output, Phase


@dataclass(kw_only=True, eq=False)
class Temporal:
    """Trains a frame, its virtual successor, and the agreement of their predictions.

    Both frames go through the same weights. Where the network normalises over the batch they go
    one after the other, as released; else as one batch, which is the same function and faster.

    Paper: the first prediction ("segmentation map") is warped to the second frame; whether its
    gradient stops is open.   Released: scores are warped, then normalised; no gradient passes.

    The loss is one of two frames (`rgbt.losses.temporal.TemporalLoss`), the view draws and applies
    virtual views (`rgbt.transforms.views.VirtualView`). At the resolution "half", the scores of
    both frames are averaged over 2x2 pixels and these means are compared. A mean counts where all
    of its pixels do. The settings are the keys of ``conf/scheme/temporal.yaml``.
    """

    model: nn.Module
    loss: Any
    view: Any
    warps: Literal["logits", "probabilities"]
    detach: bool
    resolution: Literal["full", "half"] = "full"

    def __post_init__(self) -> None:
        self.stacks = record_of(self.model, NetworkRecord).stacks_passes
        self.reads_warped = record_of(self.loss, LossRecord).reads_warped
        self.apart = any(isinstance(module, _BatchNorm) for module in self.model.modules())

    @property
    def record(self) -> SchemeRecord:
        """Require a loss of two frames, whole images, and class scores of both."""
        makes_masks = record_of(self.model, NetworkRecord).outputs == "masks"
        half = Requirement("loss", "compares_half", True, "scheme.resolution=half")
        of_view = record_of(self.view, Record)
        return SchemeRecord(
            requires=(
                Requirement("loss", "frames", 2),
                Requirement("masker", "hides_cells", False),
                *((Requirement("model", "dense_logits", True),) if makes_masks else ()),
                *((half,) if self.resolution == "half" else ()),
                *(needed.inside("scheme") for needed in of_view.requires),
            ),
            frames=2,
            camera=of_view.others.get("camera"),
        )

    def phases(self, batch: Batch, generator_of: GeneratorOf) -> Iterator[Phase]:
        """Yield one phase with the parts of Eq. 4."""
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
        """Warp class probabilities of the first frame to the second."""
        scores = (logits.detach() if self.detach else logits).float()
        if self.resolution == "half":
            scores = halved_mean(scores)
        if self.warps == "probabilities":
            return warp.bilinear(scores.softmax(1))
        return warp.bilinear(scores).softmax(1)

    def _frames(self, first: Batch, second: Batch, generator_of: GeneratorOf) -> list[Frame]:
        generator = generator_of("stochastic depth")
        batches = (first, second)
        if self.apart and not self.stacks:
            outputs = [self.model(x.rgb, x.thermal, generator=generator) for x in batches]
        else:
            rgb, thermal = (
                torch.cat([getattr(x, name) for x in batches]) for name in ("rgb", "thermal")
            )
            passes = {"passes": 2} if self.stacks else {}
            output = self.model(rgb, thermal, generator=generator, **passes)
            outputs = [self._part(output, number, len(first.name)) for number in (0, 1)]
        frames = []
        for output, batch in zip(outputs, batches, strict=True):
            logits = output.logits
            if logits is None:  # masks of queries
                model: Any = self.model
                logits = model.dense_logits(output, (batch.rgb.shape[2], batch.rgb.shape[3]))
            frames.append(Frame(output, batch, logits))
        return frames

    def _part(self, output: Output, number: int, count: int) -> Output:
        """Take the part of one of two frames from their common output."""
        if self.stacks:  # (L, P = 2, B, ...)
            one_pass = slice(number, number + 1)
            return Output(None, {name: map_[:, one_pass] for name, map_ in output.aux.items()})
        part = slice(number * count, (number + 1) * count)
        assert output.logits is not None, "a network that does not stack passes has scores"
        return Output(output.logits[part], {name: map_[part] for name, map_ in output.aux.items()})
