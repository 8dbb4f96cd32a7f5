"""The augmentation chain of CRM and SpatialSeg: resize, crop, colour, flip.

Colours are those of SSD in its order: brightness, contrast, saturation, hue. One code path serves
uint8 and float32 images. What the release does to float images differs from what it means to do,
only because OpenCV's HSV has other units there; see `Colours.rgb`.

Results are not padded: networks pad images to a multiple of 32 with their mean colour, and losses
pad labels with "ignore" (`rgbt.geometry.padding`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, Literal

import cv2
import numpy as np
from annotated_types import Interval, Predicate, doc
from numpy.typing import DTypeLike, NDArray

from rgbt.ranges import GreyLevel, Lengths, Pixels, Share, Size, rising
from rgbt.requirements import Record
from rgbt.transforms.maps import Maps, drawn_window, evaluated, short_edge_hw
from rgbt.types import Example, Sample

Image = NDArray[Any]
"""(H, W, 3) RGB, or (H, W) of thermal; uint8 or float32, 0..255."""

LEVELS = np.arange(256, dtype=np.uint8)
"""Every value of an 8-bit image."""

WIDEST_VECTOR = 64
"""8-bit values that the widest vector unit takes at a time (AVX-512)."""

Factor = Annotated[float, Interval(ge=0, le=100)]
FactorRange = Annotated[tuple[Factor, Factor], Predicate(rising), doc("the smaller one first")]
HueDelta = Annotated[int, Interval(ge=0, le=180)]


@dataclass(frozen=True, kw_only=True)
class ColourJitter:
    """SSD's colour jitter for RGB, and its contrast step for thermal.

    Factors and the added brightness (grey levels) are uniform real numbers; the added hue is a
    whole number, both ends included, in OpenCV's units (2 degrees for uint8 images).

    Source: augmentation step 3 of the CRM release (COLOR_AUG_SSD), after SSD (ECCV 2016).
    """

    colour_probability: Share
    brightness_delta: GreyLevel
    contrast_range: FactorRange
    saturation_range: FactorRange
    hue_delta: HueDelta
    thermal_contrast_range: FactorRange

    def draw_colours(self, rng: np.random.Generator) -> Colours:
        """What happens to one example; every draw comes from `rng`."""

        def drawn(low: float, high: float) -> float | None:
            return rng.uniform(low, high) if rng.random() < self.colour_probability else None

        brightness = drawn(-self.brightness_delta, self.brightness_delta)
        # The even odds of the order belong to SSD, whatever the probability of each change.
        contrast_first = bool(rng.random() < 0.5)
        contrast = drawn(*self.contrast_range) if contrast_first else None
        saturation = drawn(*self.saturation_range)
        hue = None
        if rng.random() < self.colour_probability:
            hue = int(rng.integers(-self.hue_delta, self.hue_delta + 1))
        if not contrast_first:
            contrast = drawn(*self.contrast_range)
        thermal = drawn(*self.thermal_contrast_range)
        return Colours(brightness, contrast_first, contrast, saturation, hue, thermal)


@dataclass(frozen=True, kw_only=True)
class CrmTransform(ColourJitter):
    """Resizes the short edge to a drawn length, crops, jitters colours, flips.

    Source: CRM, Sec. 4.1 (implementation details), and the dataset mapper of its release;
    SpatialSeg uses the same chain.
    Paper: random crop, colour jitter and horizontal flip of ordinary 8-bit images:
        ``colour="intended"``. Images stay uint8 and are resized as such (rounded).
    Released: images are float32 before resizing, which changes what the colour steps do
        (`Colours.rgb`): ``colour="released"``. Values between steps are not rounded.
    Both resize bilinearly with half-pixel centres and without antialiasing, and labels by nearest.
    """

    sizes: Lengths | None
    max_size: Pixels | None
    crop_hw: Size | None
    flip_probability: Share
    colour: Literal["intended", "released"]
    test_short_edge: Pixels | None
    track_position: bool

    @property
    def dtype(self) -> DTypeLike:
        """Of the images of its examples."""
        return np.uint8 if self.colour == "intended" else np.float32

    @property
    def record(self) -> Record:
        """The size of its examples."""
        return Record(crop_hw=self.crop_hw)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Augmented example."""
        maps = Maps.of(sample)
        hw = maps.hw
        if self.sizes is not None:
            hw = short_edge_hw(hw, int(rng.choice(self.sizes)), self.max_size)
        window = drawn_window(hw, self.crop_hw or hw, rng)
        flipped = bool(rng.random() < self.flip_probability)
        # Colours change pixel by pixel, so that it does not matter that the flip comes before.
        shown = maps.resize(hw, window, dtype=self.dtype).flip(flipped)
        example, colours = shown.example(self.track_position), self.draw_colours(rng)
        return replace(
            example,
            rgb=colours.rgb(example.rgb).astype(self.dtype, copy=False),
            thermal=colours.thermal(example.thermal).astype(self.dtype, copy=False),
        )

    def test(self, sample: Sample) -> Example:
        """Whole image, resized to `test_short_edge` where that is set; the label as it is."""
        return evaluated(
            sample,
            self.test_short_edge,
            track_position=self.track_position,
            max_size=self.max_size,
            dtype=self.dtype,
        )


@dataclass(frozen=True)
class Colours:
    """Changes of one example, drawn by `ColourJitter.draw_colours`; None where one does not happen.

    `contrast_first` is whether contrast comes before saturation and hue, or after them.
    """

    brightness: float | None
    contrast_first: bool
    contrast: float | None
    saturation: float | None
    hue: int | None
    thermal_contrast: float | None

    def rgb(self, image: Image) -> Image:
        """Brightness; then contrast, saturation, hue or saturation, hue, contrast.

        A uint8 image stays uint8 to the end, which is what is meant. A float32 image becomes uint8
        with the first brightness or contrast change; a saturation or hue change that comes before
        meets a float image, where OpenCV's saturation lies in 0..1 and its hue in 0..360. The
        scaled saturation is then truncated to 0 or 1, and the hue, in whole degrees, is folded
        modulo 180. This is what the release does, whose images are float32.
        """
        if self.brightness is not None:
            image = scale_and_truncate(image, offset=self.brightness)
        if self.contrast_first:
            image = _contrast(image, self.contrast)
        if self.saturation is not None:
            image = scale_saturation(image, self.saturation)
        if self.hue is not None:
            image = shift_hue(image, self.hue)
        return image if self.contrast_first else _contrast(image, self.contrast)

    def thermal(self, image: Image) -> Image:
        """Contrast alone."""
        return _contrast(image, self.thermal_contrast)


def _contrast(image: Image, factor: float | None) -> Image:
    return image if factor is None else scale_and_truncate(image, factor)


def scale_and_truncate(image: Image, factor: float = 1.0, offset: float = 0.0) -> NDArray[np.uint8]:
    """``image * factor + offset``, clipped to 0..255 and truncated to whole numbers (uint8)."""
    if image.dtype == np.uint8:  # the same arithmetic, done once for each of the 256 values
        table = scale_and_truncate(LEVELS.astype(np.float32), factor, offset)
        return np.asarray(cv2.LUT(image, table), np.uint8)
    scaled = image.astype(np.float32) * np.float32(factor) + np.float32(offset)
    return scaled.clip(0, 255).astype(np.uint8)


def scale_saturation(image: Image, factor: float) -> Image:
    """HSV saturation times `factor`, truncated to whole numbers of OpenCV's unit."""
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    if hsv.dtype == np.uint8:
        return _rgb_of(_mapped(hsv, 1, scale_and_truncate(LEVELS, factor)))
    hsv[..., 1] = scale_and_truncate(hsv[..., 1], factor)
    return _rgb_of(hsv)


def shift_hue(image: Image, shift: int) -> Image:
    """Hue, truncated to whole numbers, plus `shift`, modulo 180.

    The unit is OpenCV's: 2 degrees for uint8 and 1 for float32.
    """
    hsv = cv2.cvtColor(image, cv2.COLOR_RGB2HSV)
    if hsv.dtype == np.uint8:
        return _rgb_of(_mapped(hsv, 0, (LEVELS.astype(np.int32) + shift) % 180))
    hsv[..., 0] = (hsv[..., 0].astype(np.int32) + shift) % 180
    return _rgb_of(hsv)


def _mapped(hsv: Image, channel: int, table: NDArray[Any]) -> Image:
    """One channel of an 8-bit image through a table of its 256 values."""
    tables = np.repeat(LEVELS[:, None], 3, axis=1)
    tables[:, channel] = table.ravel()
    return np.asarray(cv2.LUT(hsv, tables[None]))


def _rgb_of(hsv: Image) -> Image:
    """HSV to RGB by OpenCV, with a result that does not depend on the position in a row.

    OpenCV 5 truncates in its vector code and rounds in what is left of a row of 8-bit pixels, so
    that a pixel would depend on the width of the image and on the processor. One long row of a
    length that every vector divides has nothing left.
    """
    if hsv.dtype != np.uint8:
        return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2RGB))
    pixels = hsv.reshape(-1, 3)
    rest = -len(pixels) % WIDEST_VECTOR
    row = np.concatenate([pixels, np.zeros((rest, 3), np.uint8)]) if rest else pixels
    rgb = cv2.cvtColor(row[None], cv2.COLOR_HSV2RGB)[0, : len(pixels)]
    return np.asarray(rgb).reshape(hsv.shape)
