"""Augmentations whose examples have one size: CMX, CMNeXt, RTFNet, the thesis, semseg, HeatNet."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import cv2
import numpy as np
from annotated_types import Interval, Len, Predicate, doc
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.ranges import GreyLevel, Pixels, Rising, Share, Size
from rgbt.requirements import TransformRecord
from rgbt.transforms.crm import Factor
from rgbt.transforms.maps import Maps, drawn_window, evaluated, mixed
from rgbt.types import IGNORE, Example, Sample

SizeFactor = Annotated[float, Interval(ge=0.01, le=16)]
Angle = Annotated[float, Interval(ge=0, le=180)]
OddPixels = Annotated[int, Interval(ge=1, le=255), Predicate(lambda side: side % 2), doc("odd")]
# Shares of R, G, B in the luma of torchvision.
LUMA = np.array([0.2989, 0.587, 0.114], np.float32)


@dataclass(frozen=True, kw_only=True)
class FixedSize:
    """Resizes whole images for evaluation; `resizing` are further options of `Maps.resize`."""

    crop_hw: Size
    flip_probability: Share
    test_short_edge: Pixels | None
    track_position: bool
    resizing: ClassVar[dict[str, Any]] = {}

    @property
    def record(self) -> TransformRecord:
        """State the size of its examples."""
        return TransformRecord(crop_hw=self.crop_hw)

    def test(self, sample: Sample) -> Example:
        """Resize the whole image to `test_short_edge` where that is set; the label stays."""
        track = self.track_position
        return evaluated(sample, self.test_short_edge, track_position=track, **self.resizing)


@dataclass(frozen=True, kw_only=True)
class CmxTransform(FixedSize):
    """Mirrors, resizes by a drawn factor, crops; what the image does not fill is padding.

    Source: CMX release (training preprocessing). There, padding is 0 in the normalised images. Here
    networks normalise images, so padding is their mean colour: 0 for them but for rounding to whole
    grey levels, and, for thermal in three channels, but for the differences of their means.
    """

    factors: Annotated[tuple[SizeFactor, ...], Len(1, 1000)]
    padding_rgb: tuple[GreyLevel, GreyLevel, GreyLevel]
    padding_order: Literal["rgb", "bgr"]
    padding_thermal: Annotated[tuple[GreyLevel, ...], Len(1, 3)]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example; padding is 255 in its label."""
        maps = Maps.of(sample).flip(rng.random() < self.flip_probability)
        factor = float(rng.choice(self.factors))
        hw = max(1, int(maps.hw[0] * factor)), max(1, int(maps.hw[1] * factor))
        shown = maps.resize(hw, drawn_window(hw, self.crop_hw, rng, "cmx"))
        rgb = np.rint(self.padding_rgb[:: 1 if self.padding_order == "rgb" else -1])
        fill = (rgb, np.rint(np.mean(self.padding_thermal)), IGNORE, 0.0)
        return shown.pad(self.crop_hw, fill).example(self.track_position)


@dataclass(frozen=True, kw_only=True)
class CmnextTransform(FixedSize):
    """Colours and blur of RGB, mirror, resize by a drawn factor, crop; the rest is black padding.

    Source: CMNeXt release (DELIVER), MFNet configuration; colours and blur of torchvision, resizing
    without smoothing. The release normalises after padding, so that padding is black, and not the
    mean, for the network.
    """

    colour_probability: Share
    colour_range: Rising[Factor]
    blur_probability: Share
    blur_deviation: Annotated[float, Interval(gt=0, le=10), doc("pixels")]
    scale_range: Rising[SizeFactor]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example; padding is 0, and 255 in its label."""
        rgb = sample.rgb
        if rng.random() < self.colour_probability:
            rgb = recoloured(rgb, *rng.uniform(*self.colour_range, size=3))
        flipped = rng.random() < self.flip_probability
        # A symmetric kernel: blurred before it is mirrored is the same as after it.
        if rng.random() < self.blur_probability:
            rgb = np.asarray(cv2.GaussianBlur(rgb, (3, 3), self.blur_deviation), np.uint8)
        maps = Maps.of(replace(sample, rgb=rgb)).flip(flipped)
        hw = scaled_hw(maps.hw, float(rng.uniform(*self.scale_range)))
        shown = maps.resize(hw, drawn_window(hw, self.crop_hw, rng, "cmnext"))
        padded = shown.pad(self.crop_hw, (0, 0, IGNORE, 0.0), (0, 0))
        return padded.example(self.track_position)


def scaled_hw(hw: tuple[int, int], factor: float) -> tuple[int, int]:
    """Multiply both sides by a factor, rounded, at least one pixel."""
    return max(1, round(hw[0] * factor)), max(1, round(hw[1] * factor))


def recoloured(
    image: NDArray[np.uint8], brightness: float, contrast: float, saturation: float
) -> NDArray[np.uint8]:
    """Change brightness, contrast and saturation of (H, W, 3), one after the other.

        mix(x, y, f) = f x + (1 - f) y, clipped to 0..255 and truncated
        a = mix(x, 0, brightness),  b = mix(a, mean luma of a, contrast)
        result = mix(b, luma of b, saturation)

    Source: torchvision's functions.
    """

    def mix(image: NDArray[np.uint8], other: Any, factor: float) -> NDArray[np.uint8]:
        share = np.float32(factor)
        both = share * image.astype(np.float32) + (1 - share) * np.asarray(other, np.float32)
        return both.clip(0, 255).astype(np.uint8)

    def luma(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        return (image.astype(np.float32) @ LUMA).astype(np.uint8)

    image = mix(image, 0, brightness)
    image = mix(image, luma(image).mean(dtype=np.float32), contrast)
    return mix(image, luma(image)[..., None], saturation)


@dataclass(frozen=True, kw_only=True)
class RtfnetTransform(FixedSize):
    """Mirrors, cuts a drawn share off every side, stretches what is left to a fixed size.

    Source: RTFNet and MFNet releases; RTFNet's paper names the flip alone. The releases leave the
    resampling of images to Pillow: nearest in the version that MFNet pins, bicubic in newer ones,
    where thermal, stored as the alpha channel, also weights the colours. Here it is bilinear.
    """

    cut_share: Annotated[float, Interval(ge=0, le=0.5)]

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example; the aspect is not kept."""
        maps = Maps.of(sample).flip(rng.random() < self.flip_probability)
        rows, columns = (draw_ends(length, self.cut_share, rng) for length in maps.hw)
        cut = maps.crop((rows, columns))
        return cut.resize(self.crop_hw).example(self.track_position)


def draw_ends(length: int, share: float, rng: np.random.Generator) -> slice:
    """Draw what is left of one axis: at most n - 1 pixels are cut at the start, n at the end.

        n = floor(share * length)
        first in 0..n-1, end in length-n..length, uniform; all of it where n is 0

    Source: RTFNet and MFNet releases, share 0.1.
    """
    largest = int(share * length)
    first = int(rng.integers(max(1, largest)))
    return slice(first, length - largest + int(rng.integers(largest + 1)))


@dataclass(frozen=True, kw_only=True)
class ThesisTransform(FixedSize):
    """Resizes the whole image to a fixed size, mirrors it, blurs RGB and thermal together.

    Source: thesis (J. Sun), its code: mirrored alone (networks with one or two heads); mirrored
    and blurred (maximum squares; by its text, HeatNet too). Images are shrunk by area. Confidences
    are mirrored with the rest, which the thesis' code forgets.
    Intended: labels by nearest.   Released: labels bilinearly, so that pixels at the border of
    two classes get the number of a third: ``label_resize="bilinear"`` (`mixed`).
    """

    blur_probability: Share
    blur_kernel: OddPixels
    label_resize: Literal["nearest", "bilinear"]
    resizing = {"area": True}

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example; the aspect is not kept, nothing is cut."""
        flipped = rng.random() < self.flip_probability
        blurred = rng.random() < self.blur_probability
        maps = Maps.of(sample)
        shown = maps.resize(self.crop_hw, area=True)
        if self.label_resize == "bilinear":
            shown = replace(shown, label=mixed(maps.label, self.crop_hw))
        shown = shown.flip(flipped)
        return (shown.blur(self.blur_kernel) if blurred else shown).example(self.track_position)


@dataclass(frozen=True, kw_only=True)
class SemsegTransform(FixedSize):
    """Scales float32 images by a drawn factor, rotates, blurs, mirrors, and cuts out a crop.

    Pixels that a rotation or padding brings in have the mean colour and are ignored in the label.

    Source: semseg (PSPNet), training script; thesis (J. Sun), configuration of its teacher.
    """

    scale_range: Rising[SizeFactor]
    rotate_probability: Share
    rotate_degrees: Angle
    blur_probability: Share
    blur_kernel: OddPixels
    padding_rgb: tuple[GreyLevel, GreyLevel, GreyLevel]
    padding_thermal: GreyLevel
    track_position: ClassVar[bool] = False  # type: ignore[misc]
    resizing = {"dtype": np.float32}

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example of `crop_hw`."""
        maps, fill = Maps.of(sample), (self.padding_rgb, self.padding_thermal, IGNORE, 0.0)
        height, width = hw = scaled_hw(maps.hw, float(rng.uniform(*self.scale_range)))
        maps = maps.resize(hw, dtype=np.float32)
        maps = maps.around(*maps.centre_yx)
        if rng.random() < self.rotate_probability:
            angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
            # semseg rotates about half the number of rows and columns.
            maps = maps.rotate(angle, (width / 2, height / 2), fill)
        if rng.random() < self.blur_probability:
            maps = maps.blur(self.blur_kernel)
        maps = maps.flip(rng.random() < self.flip_probability)
        full = (max(height, self.crop_hw[0]), max(width, self.crop_hw[1]))
        window = drawn_window(full, self.crop_hw, rng)
        return maps.pad(full, fill).crop(window).example(False)


# Grey level that the inputs of HeatNet normalise to 0.
MIDDLE = np.float32(127.5)

# Label of pixels that a rotation brings in, as released.
ROAD = 0


@dataclass(frozen=True, kw_only=True)
class HeatNetTransform:
    """Resizes, cuts, mirrors and rotates an image; drops blocks and scales thermal by day.

    Images are float32. A block of RGB or of thermal becomes the grey level that the network
    normalises to 0, 127.5; thermal is scaled towards it. The release changes day images alone, so
    the target domain gets neither (`TransformRecord.for_target`).

    Source: HeatNet, Sec. IV.   Released: jzuern/heatnet-pub, training script and loader. There,
    blocks and thermal are decided for a batch, and in the segmentation's steps alone; here for
    every image and step. There, the teacher predicts rotated images; here, its labels are rotated.
    Brought-in pixels have label 0 (road) as released, and confidence 0.
    """

    resize_hw: Size
    crop_hw: Size
    side_margin: Annotated[int, Interval(ge=0, le=8192)]
    flip_probability: Share
    rotate_probability: Share
    rotate_degrees: Angle
    drop_probability: Share
    drop_height: Rising[Pixels]
    drop_width: Rising[Pixels]
    thermal_probability: Share
    class_probability: Share
    thermal_range: Rising[Share]

    def __post_init__(self) -> None:
        room = (self.resize_hw[0], self.resize_hw[1] - 2 * self.side_margin)
        if self.crop_hw[0] > room[0] or self.crop_hw[1] > room[1]:
            raise InputError(f"transform.crop_hw={list(self.crop_hw)} exceeds {list(room)}.")
        if self.drop_height[1] > self.crop_hw[0] or self.drop_width[1] > self.crop_hw[1]:
            raise InputError("transform.drop_height, drop_width: blocks exceed transform.crop_hw.")

    @property
    def record(self) -> TransformRecord:
        """State the size of its examples; images of the target keep their blocks and thermal."""
        plain = replace(self, drop_probability=0.0, thermal_probability=0.0, class_probability=0.0)
        return TransformRecord(crop_hw=self.crop_hw, for_target=None if plain == self else plain)

    def train(self, sample: Sample, rng: np.random.Generator) -> Example:
        """Make an augmented example of `crop_hw`; no label: all pixels ignored."""
        (height, width), margin = self.crop_hw, self.side_margin
        room = (self.resize_hw[0], self.resize_hw[1] - 2 * margin)
        rows, columns = drawn_window(room, self.crop_hw, rng)
        window = (rows, slice(columns.start + margin, columns.stop + margin))
        flipped = rng.random() < self.flip_probability
        maps = Maps.of(sample).resize(self.resize_hw, window, dtype=np.float32).flip(flipped)
        if rng.random() < self.rotate_probability:
            angle = float(rng.uniform(-self.rotate_degrees, self.rotate_degrees))
            fill = ((0, 0, 0), 0, IGNORE if sample.label is None else ROAD, 0.0)
            maps = maps.rotate(angle, ((width - 1) / 2, (height - 1) / 2), fill)
        if rng.random() < self.drop_probability:
            maps = self._without_block(maps, rng)

        def scaled(thermal: NDArray[np.float32]) -> NDArray[np.float32]:
            factor = np.float32(rng.uniform(*self.thermal_range))
            return MIDDLE + factor * (thermal - MIDDLE)

        thermal = maps.thermal
        if rng.random() < self.thermal_probability:
            thermal = scaled(thermal)
        if rng.random() < self.class_probability:
            for label in np.unique(maps.label):
                thermal = np.where(maps.label == label, scaled(thermal), thermal)
        return replace(maps, thermal=thermal).example(False)

    def _without_block(self, maps: Maps, rng: np.random.Generator) -> Maps:
        """Set one block of RGB or of thermal to the middle grey level."""
        low, high = self.drop_height
        height = int(rng.integers(low, max(high, low + 1)))
        low, high = self.drop_width
        width = int(rng.integers(low, max(high, low + 1)))
        window = drawn_window(self.crop_hw, (height, width), rng)
        name = "rgb" if rng.random() < 0.5 else "thermal"
        image = getattr(maps, name).copy()
        image[window] = MIDDLE
        return replace(maps, **{name: image})

    def test(self, sample: Sample) -> Example:
        """Resize the whole image to `resize_hw`; the label stays as it is."""
        maps = Maps.of(sample)
        example = maps.resize(self.resize_hw, dtype=np.float32).example(False)
        return replace(example, label=maps.label, confidence=maps.confidence)
