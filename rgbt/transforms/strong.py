"""Strong augmentation of images that are already on the device: colour jitter and blur.

It changes no position, so that labels and masks stay valid. A scheme applies it to images that are
made in the step, such as a mix of two images; the transforms of a data set augment single samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import torch
from annotated_types import Interval, Predicate, doc
from torch import Tensor
from torch.nn import functional as F

from rgbt.processes import own_draw
from rgbt.ranges import Share, rising
from rgbt.transforms.hsv import to_hsv, to_rgb

Strength = Annotated[float, Interval(ge=0, le=0.5), doc("0.5 turns the hue by half a circle")]
Sigma = Annotated[float, Interval(ge=0.01, le=50), doc("pixels")]
SigmaRange = Annotated[tuple[Sigma, Sigma], Predicate(rising), doc("the smaller one first")]

HALF_CIRCLE = 90
"""Of the hue, in OpenCV's units."""

CHANGES = ("brightness", "contrast", "saturation", "hue")
OF_THERMAL = ("thermal_brightness", "thermal_contrast")


@dataclass(frozen=True, kw_only=True)
class StrongAugmentation:
    """Colour jitter of RGB, its brightness and contrast for thermal, and Gaussian blur of both.

    With strength s, draws u of U(-s, s) and values clipped to [0, 1] after every change:

        brightness  x + u           contrast  (1 + u) x
        saturation  (1 + u) S       hue       H + u (circles)

    in random order; saturation and hue are of HSV in 8 bits. Thermal has no colour: brightness and
    contrast, with draws of its own.

    Source: DACS and its release, from which DAFormer, HRDA and MIC have it: s = 0.2 in 80 % of the
    steps, blur in 50 %, sigma in U(0.15, 1.15).
    Released: as here, whether an image is changed is drawn for the batch, and by how much for each
    image. The order is drawn for each image, here for the batch; the kernel of the blur has a tenth
    of the image, here 4 sigma on each side.

    Attributes:
        jitter_probability: in [0, 1], of the batch.
        jitter_strength: s.
        blur_probability: in [0, 1], of the batch.
        blur_sigma: the standard deviation is uniform in [low, high], pixels.
    """

    jitter_probability: Share
    jitter_strength: Strength
    blur_probability: Share
    blur_sigma: SigmaRange

    def __call__(
        self, rgb: Tensor, thermal: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Changed images of the same shapes, float32 in [0, 1].

        Args:
            rgb: (B, 3, H, W) float32 in [0, 1].
            thermal: (B, 1, H, W) float32 in [0, 1].
            generator: on the device of the images; the number of draws is always the same.
        """
        device = rgb.device

        def draw(count: int) -> Tensor:
            names = len(CHANGES) + len(OF_THERMAL) + 1
            return torch.rand(count, names, generator=generator, device=device)

        whole = torch.rand(2 + len(CHANGES), generator=generator, device=device)
        *changes, blur = own_draw(draw, len(rgb)).unbind(1)
        by = {
            name: (self.jitter_strength * (2 * each - 1)).view(-1, 1, 1, 1)
            for name, each in zip((*CHANGES, *OF_THERMAL), changes, strict=True)
        }
        jitters, blurs, *order = whole.tolist()  # one wait for the device
        if jitters < self.jitter_probability:
            for _, name in sorted(zip(order, CHANGES, strict=True)):
                rgb = jittered(rgb, name, by[name])
            thermal = jittered(thermal, "brightness", by["thermal_brightness"])
            thermal = jittered(thermal, "contrast", by["thermal_contrast"])
        if blurs < self.blur_probability:
            low, high = self.blur_sigma
            sigma = low + (high - low) * blur
            rgb, thermal = (blurred(each, sigma, high) for each in (rgb, thermal))
        return rgb, thermal


def jittered(images: Tensor, change: str, by: Tensor) -> Tensor:
    """One of `CHANGES` of images (B, C, H, W) in [0, 1] by (B, 1, 1, 1), see the class."""
    if change == "brightness":
        return (images + by).clamp(0, 1)
    if change == "contrast":
        return (images * (1 + by)).clamp(0, 1)
    levels = (images * 255).round().long().movedim(1, -1)
    hue, saturation, value = to_hsv(levels)
    if change == "saturation":
        saturation = (saturation * (1 + by[:, 0])).round().clamp(0, 255).long()
    else:
        hue = (hue + (2 * HALF_CIRCLE * by[:, 0]).round().long()) % (2 * HALF_CIRCLE)
    return to_rgb(hue, saturation, value).movedim(-1, 1).to(images.dtype) / 255


def blurred(images: Tensor, sigma: Tensor, largest: float) -> Tensor:
    """Images (B, C, H, W) after Gaussian blur with sigma (B,), at most `largest`, in pixels.

    The kernel ends at 4 `largest`; beyond the border, the pixels of the border are repeated.
    """
    radius = math.ceil(4 * largest)
    offsets = torch.arange(-radius, radius + 1, device=images.device)
    weights = (-(offsets**2) / (2 * sigma[:, None] ** 2)).exp()
    weights = (weights / weights.sum(1, keepdim=True)).repeat_interleave(images.shape[1], 0)
    maps = F.pad(images.flatten(0, 1)[None], [radius] * 4, mode="replicate")
    for shape in ((-1, 1, 2 * radius + 1, 1), (-1, 1, 1, 2 * radius + 1)):
        maps = F.conv2d(maps, weights.view(shape).to(images.dtype), groups=len(weights))
    return maps.view_as(images)
