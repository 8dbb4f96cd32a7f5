"""The types that the components of rgbt exchange.

Letters, everywhere: ``B`` batch, ``C`` channels, ``H W`` pixels, ``h w`` cells or feature grid,
``K`` classes, ``Q`` queries, ``R`` regions, ``P`` stacked passes of one batch, ``L`` prediction
layers.
RGB order, (row, column), labels int64 (uint8 before the device) with 255 = ignore, mask True =
hidden, resize with ``align_corners=False``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Protocol, TypeAlias

if TYPE_CHECKING:  # commands that show results import these types without NumPy and torch
    import numpy as np
    import torch
    from numpy.typing import NDArray
    from torch import Tensor

IGNORE = 255

# Input images of a prediction: both, or one alone.
View = Literal["rgbt", "rgb", "thermal"]

VIEWS: tuple[View, ...] = ("rgbt", "rgb", "thermal")

# purpose -> generator; the same purpose in the same step always gives the same draws.
GeneratorOf: TypeAlias = "Callable[[str], torch.Generator]"


@dataclass(frozen=True)
class Sample:
    """One labelled RGB-thermal pair as stored on disk: no augmentation, no masking.

    Attributes:
        rgb: (H, W, 3) uint8, RGB order.
        thermal: (H, W) uint8.
        label: (H, W) uint8, class index or 255 = ignore; None where the pair is unlabelled.
        name: name in the split list, without extension.
        confidence: (H, W) float32 in [0, 1], confidence of the teacher that predicted the labels;
            None for labels without confidence.
    """

    rgb: NDArray[np.uint8]
    thermal: NDArray[np.uint8]
    label: NDArray[np.uint8] | None
    name: str
    confidence: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Example:
    """A sample after the transform, not yet padded to the size that a network requires.

    Attributes:
        rgb: (H, W, 3), uint8 or float32, 0..255, RGB order.
        thermal: (H, W), dtype and range of `rgb`.
        label: (H', W') uint8, class index or 255 = ignore. H' = H and W' = W after `train`; after
            `test` the size of the file, which may differ from that of the images.
        centre_yx: pixel of the example that is nearest to pixel (rows // 2, columns // 2) of the
            original image; the first in row-major order on a tie.
        position: (2, H, W) float32, (row, column) in the original image of every pixel; None
            where it is not tracked.
        original_hw: size of the original image.
        name: name in the split list.
        confidence: (H', W') float32, of the label, transformed as the label is, with nearest
            interpolation; None for labels without confidence.
    """

    rgb: NDArray[Any]
    thermal: NDArray[Any]
    label: NDArray[np.uint8]
    centre_yx: tuple[int, int]
    position: NDArray[np.float32] | None
    original_hw: tuple[int, int]
    name: str
    confidence: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Batch:
    """Samples after the transform, stacked.

    Attributes:
        rgb: (B, 3, H, W); uint8 or float32 in 0..255 from the loader, float32 in [0, 1] after
            ``to``.
        thermal: (B, 1, H, W), same dtype rule as ``rgb``.
        label: (B, H', W') uint8 from the loader, int64 after ``to``; 255 = ignore. In training
            H' = H and W' = W; in evaluation they are the size of the file.
        name: B names.
        centre_yx: (B, 2) int64, see `Example`.
        position: (B, 2, H, W) float32, see `Example`; None where it is not tracked.
        original_hw: (B, 2) int64, height and width of the original image.
        confidence: (B, H', W') float32 in [0, 1], of the labels; None where they carry none.
    """

    rgb: Tensor
    thermal: Tensor
    label: Tensor
    name: tuple[str, ...]
    centre_yx: Tensor
    position: Tensor | None
    original_hw: Tensor
    confidence: Tensor | None = None

    def to(self, device: torch.device | str) -> Batch:
        """Move the batch to `device`, with images as float32 in [0, 1]."""

        def moved(tensor: Tensor) -> Tensor:
            return tensor.to(device, non_blocking=True)

        return replace(
            self,
            rgb=moved(self.rgb).float() / 255.0,
            thermal=moved(self.thermal).float() / 255.0,
            label=moved(self.label).long(),
            centre_yx=moved(self.centre_yx),
            position=None if self.position is None else moved(self.position),
            original_hw=moved(self.original_hw),
            confidence=None if self.confidence is None else moved(self.confidence),
        )


@dataclass(frozen=True)
class TwoDomains:
    """The input of one step of domain adaptation: a batch of each domain, drawn independently.

    Attributes:
        source: with labels.
        target: with or without labels (all pixels 255), as the configuration says.
        step: optimiser step that it is for, counted from the start of the run.
    """

    source: Batch
    target: Batch
    step: int

    @property
    def name(self) -> tuple[str, ...]:
        """Names of all samples, those of the source first."""
        return self.source.name + self.target.name

    def to(self, device: torch.device | str) -> TwoDomains:
        """Move both batches to `device` (see `Batch.to`)."""
        return TwoDomains(self.source.to(device), self.target.to(device), self.step)


class SceneMaps(NamedTuple):
    """What a rendered image shows at each pixel, beyond the label.

    Attributes:
        depth_m: (H, W) float32, metres along the optical axis; infinity for the sky.
        objects: (H, W) int32, number of the object from 1; 0 where there is none.
    """

    depth_m: NDArray[np.float32]
    objects: NDArray[np.int32]


class MaskPair(NamedTuple):
    """Which cells are hidden: rgb (B, h, w) and thermal (B, h, w), bool, True = hidden."""

    rgb: Tensor
    thermal: Tensor


class Output(NamedTuple):
    """The output of a network.

    Attributes:
        logits: (B, K, H, W) class scores at the size of the input image. None in training mode for
            networks whose loss reads `aux` instead (a dense map would be computed for nothing).
        aux: named intermediates; each network documents its names and shapes.
    """

    logits: Tensor | None
    aux: dict[str, Tensor]


class Frame(NamedTuple):
    """One of two frames of a scene in a training step (`rgbt.schemes.temporal`).

    Attributes:
        output: what the network returned for it.
        batch: its images and labels.
        logits: (B, K, H, W) float, dense class scores, also of networks that return masks.
    """

    output: Output
    batch: Batch
    logits: Tensor


class Phase(NamedTuple):
    """One backward pass, and the optimisers that step after it.

    Attributes:
        optimizers: their names; parameters that two of them share are stepped by each.
        parts: named, weighted loss parts.
        clear: whether all gradients are cleared before; False adds to those of the phase before.
        idle: names of optimisers that also step, with gradients of 0: their moving averages decay.
        logged: named scalars that are logged beside the parts and not trained.
    """

    optimizers: tuple[str, ...]
    parts: dict[str, Tensor]
    clear: bool = True
    idle: tuple[str, ...] = ()
    logged: Mapping[str, Tensor] = MappingProxyType({})


class AnyMasker(Protocol):
    """The interface of a masker, which draws hidden cells (see `rgbt.maskers.masker.Masker`).

    A crop is padded at the bottom and right to multiples of 32 pixels before cells are cut
    (120 x 160 becomes 128 x 160), so that h and w divide the padded height and width.
    """

    def __call__(
        self, image_hw: tuple[int, int], centre_yx: Tensor, generator: torch.Generator
    ) -> MaskPair:
        """Draw cells of a crop of `image_hw` pixels, padded, for each row of `centre_yx`."""
        ...


class Loss(Protocol):
    """The interface of a loss between the output of a network and a batch."""

    def __call__(
        self, output: Output, batch: Batch, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Return named, weighted parts of shape (P,): one value per stacked pass of the batch."""
        ...
