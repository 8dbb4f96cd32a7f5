"""Inputs of a network: channel order, normalisation, padding, hidden pixels, the view it is shown.

Weights require the convention of their training: with other inputs, a released network gives other
results. `conf/model/inputs/` has one file per release.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

import torch
from annotated_types import Interval, Len
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.checks import InputError
from rgbt.geometry.padding import padded_hw
from rgbt.ranges import GreyLevel
from rgbt.requirements import NetworkRecord
from rgbt.types import MaskPair, Output, View


class Images(NamedTuple):
    """Holds normalised images: rgb (N, 3, H', W') and thermal (N, c, H', W'), padded with 0."""

    rgb: Tensor
    thermal: Tensor


Deviation = Annotated[float, Interval(ge=0.001, le=10_000)]


class Inputs(nn.Module):
    """Converts images in [0, 1] to what a network was trained on: ``(255 x - mean) / std``.

    The arguments are the keys of ``conf/model/inputs/crm.yaml``. "gray" is the luma in all three
    channels. A single thermal channel is repeated for three values. With "image_max", an image of
    zeros stays one.

    Raises:
        InputError: not 1 or 3 thermal channels; lists of different length.
    """

    rgb_mean: Tensor
    rgb_std: Tensor
    thermal_mean: Tensor
    thermal_std: Tensor

    def __init__(
        self,
        *,
        rgb_order: Literal["rgb", "bgr", "gray"],
        rgb_mean: tuple[GreyLevel, GreyLevel, GreyLevel],
        rgb_std: tuple[Deviation, Deviation, Deviation],
        thermal_mean: Annotated[tuple[GreyLevel, ...], Len(1, 3)],
        thermal_std: Annotated[tuple[Deviation, ...], Len(1, 3)],
        thermal_scale: Literal["fixed", "image_max"],
    ) -> None:
        super().__init__()
        if len(thermal_mean) == 2 or len(thermal_std) != len(thermal_mean):
            raise InputError("model.inputs: thermal_mean and thermal_std must both have 1 or 3.")
        self.rgb_order = rgb_order
        self.thermal_scale = thermal_scale
        self.thermal_channels = len(thermal_mean)
        names = ("rgb_mean", "rgb_std", "thermal_mean", "thermal_std")
        for name, values in zip(names, (rgb_mean, rgb_std, thermal_mean, thermal_std), strict=True):
            scaled = torch.tensor(values).view(-1, 1, 1) / 255
            self.register_buffer(name, scaled, persistent=False)

    def forward(
        self, rgb: Tensor, thermal: Tensor, masks: MaskPair | None = None, *, multiple: int = 1
    ) -> Images:
        """Normalise images; hidden pixels and padding are 0: the mean, or black where that is 0.

        Arguments and errors as `rgbt.models` says; sides are padded at the bottom and right to
        multiples of `multiple`.
        """
        count, _, height, width = rgb.shape
        if rgb.shape[1] != 3 or thermal.shape != (count, 1, height, width):
            shapes = tuple(rgb.shape), tuple(thermal.shape)
            raise ValueError(f"rgb and thermal: expected (N, 3, H, W), (N, 1, H, W), got {shapes}.")
        if self.rgb_order == "bgr":
            rgb = rgb.flip(1)
        elif self.rgb_order == "gray":
            rgb = luma_of(rgb).expand_as(rgb)
        if self.thermal_scale == "image_max":
            # The smallest float only matters where the whole image is 0.
            brightest = thermal.amax((1, 2, 3), keepdim=True)
            thermal = thermal / brightest.clamp(min=torch.finfo(thermal.dtype).tiny)
        images = [
            (rgb - self.rgb_mean) / self.rgb_std,
            (thermal - self.thermal_mean) / self.thermal_std,
        ]
        if masks is not None:
            cells = expand_cells(masks, count, padded_hw((height, width)))
            images = [
                image.masked_fill(hidden[:, None, :height, :width], 0.0)
                for image, hidden in zip(images, cells, strict=True)
            ]
        return Images(*(padded(image, multiple) for image in images))


class Network(nn.Module):
    """Predicts dense class scores of one view of normalised images, without those of padding.

    `multiple` divides the sides of the padded images. Each network has a method
    `predict(images, view, generator)`, whose docstring says what it adds to `rgbt.models`.
    """

    record: NetworkRecord
    inputs: Inputs
    multiple = 1
    predict: Any

    def forward(
        self,
        rgb: Tensor,
        thermal: Tensor,
        masks: MaskPair | None = None,
        *,
        views: tuple[View, ...] = (),
        generator: torch.Generator | None = None,
        **options: Any,
    ) -> Output:
        """Predict as `rgbt.models` says; `options` are further arguments of `predict`."""
        view = only_view(views, self.record.views, type(self).__name__)
        images = self.inputs(rgb, thermal, masks, multiple=self.multiple)
        logits, aux = self.predict(images, view, generator, **options)
        if self.multiple > 1:
            height, width = rgb.shape[2:]
            logits = logits[..., :height, :width]
            if "aux_logits" in aux:
                aux["aux_logits"] = aux["aux_logits"][..., :height, :width]
        return Output(logits, aux)


def padded(image: Tensor, multiple: int) -> Tensor:
    """Pad (N, C, H, W) with 0 at the bottom and right to sides that `multiple` divides."""
    below, right = (-side % multiple for side in image.shape[2:])
    is_padded = isinstance(below, int) and not (below or right)  # not in a graph for any size
    return image if is_padded else F.pad(image, (0, right, 0, below))


def luma_of(rgb: Tensor) -> Tensor:
    """Compute 0.299 R + 0.587 G + 0.114 B (ITU-R BT.601): (N, 3, H, W) -> (N, 1, H, W)."""
    weights = rgb.new_tensor([0.299, 0.587, 0.114]).view(1, 3, 1, 1)
    return (rgb * weights).sum(1, keepdim=True)


def as_rgb(thermal: Tensor) -> Tensor:
    """Expand a thermal image (N, 1 or 3, H, W) to the three channels of a branch: (N, 3, H, W)."""
    return thermal.expand(-1, 3, -1, -1)


def expand_cells(masks: MaskPair, count: int, image_hw: tuple[int, int], unit: int = 1) -> MaskPair:
    """Expand cells (N, h, w) to squares of `unit` x `unit` pixels, (N, H/unit, W/unit) bool each.

    `count` is the N that is expected, `image_hw` the padded size, `unit` 1 for pixels or 4 for the
    tokens of a Swin.

    Raises:
        InputError: another N, or cells that are not squares of a multiple of `unit` pixels.
    """
    found = []
    for mask in masks:
        cells, h, w = mask.shape
        cell = image_hw[0] // h
        if cells != count or cell % unit or (h * cell, w * cell) != image_hw:
            raise InputError(
                f"masker.patch_size: {cells} masks of {h} x {w} cells do not divide {count} padded "
                f"images of {image_hw} pixels into squares of a multiple of {unit} pixels."
            )
        found.append(mask.repeat_interleave(cell // unit, 1).repeat_interleave(cell // unit, 2))
    return MaskPair(*found)


def only_view(views: tuple[View, ...], known: tuple[View, ...], network: str) -> View:
    """Return the requested view of a network without stacked views; InputError for another one.

    `views` as its `forward` got them (empty: the first of `known`), its views, and its name.
    """
    requested = views or known[:1]
    if len(requested) > 1 or requested[0] not in known:
        raise InputError(
            f"modality: {network} predicts from {' or '.join(known)}, one at a time, but got "
            f"{', '.join(requested)}."
        )
    return requested[0]
