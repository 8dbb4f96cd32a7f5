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
            generator: of any device; the number of draws is always the same.
        """
        def draw(count: int) -> Tensor:
            names = len(CHANGES) + len(OF_THERMAL) + 1
            drawn = torch.rand(count, names, generator=generator, device=generator.device)
            return drawn.to(rgb.device)

        whole = torch.rand(2 + len(CHANGES), generator=generator, device=generator.device)
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


SHIFT = 12
"""Binary digits of the fraction in the whole-number divisions of `to_hsv`."""


def to_hsv(rgb: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Hue, saturation and value, each (...,) int64; the bits of OpenCV's COLOR_RGB2HSV.

    Args:
        rgb: (..., 3) int64, 0..255.
    """
    red, green, blue = rgb.unbind(-1)
    value = rgb.amax(-1)
    spread = value - rgb.amin(-1)
    of_255, of_180 = _divisions(rgb.device)
    half = 1 << (SHIFT - 1)
    saturation = (spread * of_255[value] + half) >> SHIFT
    sixth = torch.where(
        value == red,
        green - blue,
        torch.where(value == green, blue - red + 2 * spread, red - green + 4 * spread),
    )
    hue = (sixth * of_180[spread] + half) >> SHIFT
    return torch.where(hue < 0, hue + 180, hue), saturation, value


def to_rgb(hue: Tensor, saturation: Tensor, value: Tensor) -> Tensor:
    """(..., 3) int64, 0..255: the bits of OpenCV's COLOR_HSV2RGB in its vector code.

    Products are rounded to float32 where OpenCV rounds them, and the last step truncates.

    Args:
        hue: (...,) int64, 0..179.
        saturation: (...,) int64, 0..255.
        value: (...,) int64, 0..255.
    """
    sextant = hue // 30
    turned = hue.float() * _float32(6 / 180)
    fraction = turned - turned.floor()
    grey = saturation.float() * _float32(1 / 255)
    light = value.float() * _float32(1 / 255)
    none = light * (1.0 - grey)
    falling = light * _less_product(grey, fraction)
    rising = light * _less_product(grey, 1.0 - fraction)
    levels = torch.stack([light, none, falling, rising], dim=-1)
    levels = (levels * 255.0).to(torch.int64)
    # Of red, green and blue in each sixth of the circle: which of the four levels it has.
    order = torch.tensor(
        [[0, 3, 1], [2, 0, 1], [1, 0, 3], [1, 2, 0], [3, 1, 0], [0, 1, 2]], device=hue.device
    )
    return levels.gather(-1, order[sextant])


def _less_product(one: Tensor, other: Tensor) -> Tensor:
    """1 - one * other, rounded once: a fused multiply-add, which OpenCV's vector code uses.

    In float64 the product of two float32 is exact.
    """
    return (1.0 - one.double() * other.double()).float()


def _float32(number: float) -> float:
    """The nearest float32: a Python number would be rounded after the product, not before it."""
    return float(torch.tensor(number, dtype=torch.float32))


def _divisions(device: torch.device) -> tuple[Tensor, Tensor]:
    """(256,) int64 each: 255 / i and 180 / (6 i) with `SHIFT` binary digits; 0 at i = 0."""
    index = torch.arange(256, dtype=torch.float64).clamp(min=1)
    tables = [((top << SHIFT) / (by * index)).round().long() for top, by in ((255, 1), (180, 6))]
    for table in tables:
        table[0] = 0
    return tables[0].to(device), tables[1].to(device)
