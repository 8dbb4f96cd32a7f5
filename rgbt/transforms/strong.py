"""Strong augmentation of images that are made in a step, such as a mix: colour jitter and blur."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import torch
from annotated_types import Interval, doc
from torch import Tensor
from torch.nn import functional as F

from rgbt.processes import own_draw
from rgbt.ranges import Rising, Share
from rgbt.transforms.crm import shift_hue, with_hsv

Strength = Annotated[float, Interval(ge=0, le=0.5), doc("0.5 turns the hue by half a circle")]
Sigma = Annotated[float, Interval(ge=0.01, le=50), doc("pixels")]

CHANGES = ("brightness", "contrast", "saturation", "hue")
THERMAL_SETTINGS = ("thermal_brightness", "thermal_contrast")


@dataclass(frozen=True, kw_only=True)
class StrongAugmentation:
    """Jitters colours of RGB, brightness and contrast of thermal, and blurs both.

    With strength s, draws u of U(-s, s) and values clipped to [0, 1] after every change:

        brightness  x + u           contrast  (1 + u) x
        saturation  (1 + u) S       hue       H + u (circles)

    in random order; saturation and hue are of HSV in 8 bits, by OpenCV on the CPU.

    Source: DACS and its release, from which DAFormer, HRDA and MIC have it: s = 0.2 in 80 % of the
    steps, blur in 50 %, sigma in U(0.15, 1.15), each drawn for the batch.
    Released: the order is drawn for each image, here for the batch; the kernel of the blur has a
    tenth of the image, here 4 sigma on each side.
    """

    jitter_probability: Share
    jitter_strength: Strength
    blur_probability: Share
    blur_sigma: Rising[Sigma]

    def __call__(
        self, rgb: Tensor, thermal: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Change images (B, 3, H, W) and (B, 1, H, W) float32 in [0, 1], and return them.

        `generator` is of any device; the number of draws is always the same.
        """
        device, names = generator.device, (*CHANGES, *THERMAL_SETTINGS)

        def draw(count: int) -> Tensor:
            drawn = torch.rand(count, len(names) + 1, generator=generator, device=device)
            return drawn.to(rgb.device)

        whole = torch.rand(2 + len(CHANGES), generator=generator, device=device)
        *changes, blur = own_draw(draw, len(rgb)).unbind(1)
        by = {
            name: (self.jitter_strength * (2 * uniform - 1)).view(-1, 1, 1, 1)
            for name, uniform in zip(names, changes, strict=True)
        }
        jitters, blurs, *order = whole.tolist()
        if jitters < self.jitter_probability:
            for _, name in sorted(zip(order, CHANGES, strict=True)):
                rgb = jittered(rgb, name, by[name])
            thermal = jittered(thermal, "brightness", by["thermal_brightness"])
            thermal = jittered(thermal, "contrast", by["thermal_contrast"])
        if blurs < self.blur_probability:
            low, high = self.blur_sigma
            sigma = low + (high - low) * blur
            rgb, thermal = blurred(rgb, sigma, high), blurred(thermal, sigma, high)
        return rgb, thermal


def jittered(images: Tensor, change: str, by: Tensor) -> Tensor:
    """Make one of `CHANGES` to images (B, C, H, W) in [0, 1] by (B, 1, 1, 1), see the class."""
    if change == "brightness":
        return (images + by).clamp(0, 1)
    if change == "contrast":
        return (images * (1 + by)).clamp(0, 1)
    levels = (images * 255).round().byte().movedim(1, -1).contiguous().cpu().numpy()
    if change == "saturation":
        factors = (1 + by).flatten().cpu().numpy()
        found = [
            with_hsv(image, 1, lambda s, f=factor: np.rint(s * f).clip(0, 255))  # type: ignore[misc]
            for image, factor in zip(levels, factors, strict=True)
        ]
    else:
        shifts = (180 * by).round().long().flatten().tolist()  # OpenCV's circle has 180 units
        found = [shift_hue(image, shift) for image, shift in zip(levels, shifts, strict=True)]
    return torch.from_numpy(np.stack(found)).to(images).movedim(-1, 1) / 255


def blurred(images: Tensor, sigma: Tensor, largest: float) -> Tensor:
    """Blur images (B, C, H, W) by Gaussians of sigma (B,), at most `largest`, in pixels.

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
