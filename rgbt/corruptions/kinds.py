"""The corruptions, which change the pixels of a pair or show the thermal image of another frame.

Severity 0 is the clean image and never reaches a corruption. Lengths are given in pixels of an
image of 480 rows and scaled to the height of the file. Frames are counted in the order of the split
list, by day and by night apart; published lists leave frames out.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar, Literal, Protocol, runtime_checkable

import cv2
import numpy as np
from annotated_types import Interval, Len, Predicate, doc
from numpy.typing import NDArray

from rgbt.checks import InputError, check_range
from rgbt.types import Sample

# Rows of the images that lengths in pixels are given for: MFNet's.
REFERENCE_HEIGHT = 480

Pixels = NDArray[np.uint8]
Image = Literal["rgb", "thermal"]
# Which image of a pair is corrupted.
Images = Literal["rgb", "thermal", "both"]

NAMES: dict[Images, str] = {"rgb": "RGB", "thermal": "thermal", "both": "RGB and thermal"}

# (rows, columns): up, down, left, right.
DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))

# Purpose -> generator of a sample, the same at every severity: a higher one hides more blocks.
RngOf = Callable[[str], np.random.Generator]

Severities = Annotated[
    tuple[Annotated[float, Interval(gt=0, le=1000)], ...],
    Len(1, 100),
    Predicate(lambda ladder: all(a < b for a, b in zip(ladder, ladder[1:], strict=False))),
    doc("rising numbers above 0, the clean image, which is always measured"),
]


@dataclass(frozen=True, kw_only=True)
class Corruption:
    """Checks severities by two bounds in a unit ("" of a single one); own classes need not."""

    severities: Severities
    name: ClassVar[str]
    unit: ClassVar[str]
    bounds: ClassVar[tuple[float, float]]

    def __post_init__(self) -> None:
        for severity in self.severities:
            self.check(severity)

    @property
    def title(self) -> str:
        """Return the name in tables and figures, e.g. "noise, RGB"."""
        return self.name

    def check(self, severity: float) -> None:
        """Refuse (InputError) a severity (> 0) out of the bounds."""
        unit = f" ({self.unit})" if self.unit else ""
        check_range(f"severity{unit}", severity, *self.bounds)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """Corrupt `sample`, uint8 as before; the label and the name stay.

        InputError where the severity changes nothing of an image of this size.
        """
        raise NotImplementedError


@runtime_checkable
class OfTime(Protocol):
    """Shows the thermal image of another frame."""

    def shown(self, index: int, severity: float) -> int:
        """Return the frame whose thermal image is shown at `index`; 0 is the first frame."""


@dataclass(frozen=True, kw_only=True)
class _Pixels(Corruption):
    """Corrupts RGB, thermal, or both (`image`)."""

    image: Images

    @property
    def title(self) -> str:
        return self.name.format(NAMES[self.image])

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        changed = {
            image: self._changed(getattr(sample, image), severity, rng_of, image)
            for image in (("rgb", "thermal") if self.image == "both" else (self.image,))
        }
        return replace(sample, **changed)  # type: ignore[arg-type]

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Occluded(_Pixels):
    """Blackens a share of the square blocks of the image (0, see `Removed`).

    The blocks lie on a grid from the top left; those at the right and at the bottom may be cut.
    Exactly the nearest whole number to ``share x blocks`` is hidden, drawn without replacement, the
    same blocks in RGB and in thermal with ``image: both``. `block` is the side of a block in pixels
    at 480 rows; at least 1 pixel.
    """

    block: Annotated[int, Interval(ge=1, le=REFERENCE_HEIGHT)]
    name, unit, bounds = "occluded, {}", "share of blocks", (0, 1)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        del image  # the same generator for both, so that the same blocks are hidden
        pixels = pixels.copy()
        pixels[self.hidden(pixels.shape[:2], severity, rng_of("occluded"))] = 0
        return pixels

    def hidden(
        self, image_hw: tuple[int, ...], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """Draw which pixels are hidden, (H, W); those of a smaller share and more."""
        height, width = image_hw
        side = max(1, nearest_whole(at_height(self.block, height)))
        rows, columns = -(-height // side), -(-width // side)
        number = nearest_whole(share * rows * columns)
        if number == 0:
            raise InputError(f"severity: {share:g} of {rows} x {columns} blocks hides no block.")
        blocks = np.zeros(rows * columns, bool)
        blocks[rng.permutation(rows * columns)[:number]] = True
        grid = blocks.reshape(rows, columns).repeat(side, 0).repeat(side, 1)
        return np.asarray(grid[:height, :width])


@dataclass(frozen=True, kw_only=True)
class Noise(_Pixels):
    """Adds Gaussian noise to every pixel and channel, independent, rounded, cut at 0 and 255."""

    name, unit, bounds = "noise, {}", "grey levels (std)", (0, 255)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        noise = rng_of(f"noise {image}").standard_normal(pixels.shape, dtype=np.float32)
        return np.rint(pixels + np.float32(severity) * noise).clip(0, 255).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Blur(_Pixels):
    """Blurs by a Gaussian; the image is mirrored at its edges."""

    name, unit, bounds = "blur, {}", "pixels at 480 rows (sigma)", (0, REFERENCE_HEIGHT / 4)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        del rng_of, image  # nothing is drawn
        sigma = at_height(severity, pixels.shape[0])
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Removed(_Pixels):
    """Blackens one image of the pair: every pixel is 0 in the file's grey levels.

    That is before the normalisation: what a network sees depends on ``conf/model/inputs/``, from
    -2.12 (``crm``) to 0 (``unit``). Masked cells of a training become a learned token instead.

    CRM, Table 1 ("RGB drop", "THR drop") does not say how an image is dropped, and no release shows
    it. Networks that decode a single branch have that as another test (``modality=thermal``).
    """

    image: Image
    name, unit, bounds = "{} removed (zeroed)", "", (1, 1)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        del severity, rng_of, image  # there is one way to be missing
        return np.zeros_like(pixels)


@dataclass(frozen=True, kw_only=True)
class Misregistered(Corruption):
    """Moves thermal by n pixels up, down, left or right, as drawn for each image.

    Whole pixels, so that nothing is interpolated. What comes in from outside repeats the edge: a
    black stripe would be a corruption of its own.
    """

    name, unit = "misregistered thermal", "pixels at 480 rows"
    bounds = (0, REFERENCE_HEIGHT / 2)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """Corrupt a sample as `Corruption` says."""
        height = sample.thermal.shape[0]
        distance = nearest_whole(at_height(severity, height))
        if distance == 0:
            raise InputError(f"severity: {severity:g} is below half a pixel of {height} rows.")
        rows, columns = DIRECTIONS[int(rng_of("misregistered").integers(len(DIRECTIONS)))]
        return replace(sample, thermal=moved(sample.thermal, rows * distance, columns * distance))


@dataclass(frozen=True, kw_only=True)
class Delayed(Corruption):
    """Shows the thermal image of n frames earlier; the first n frames show the first one."""

    name, unit, bounds = "delayed thermal", "frames", (1, 1000)

    def check(self, severity: float) -> None:
        """Refuse (InputError) all but whole frames."""
        super().check(severity)
        if not severity.is_integer():
            raise InputError(f"severity: expected a number of frames, got {severity:g}.")

    def shown(self, index: int, severity: float) -> int:
        """Return the frame whose thermal image is shown at `index`."""
        return max(0, index - int(severity))


@dataclass(frozen=True, kw_only=True)
class Frozen(Delayed):
    """Shows one thermal image for n frames: that of frame n, 2 n, 3 n, ..."""

    name, unit, bounds = "frozen thermal", "frames between two images", (2, 1000)

    def shown(self, index: int, severity: float) -> int:
        """Return the frame whose thermal image is shown at `index`."""
        return index - index % int(severity)


def at_height(pixels: float, height: int) -> float:
    """Scale a length of the reference height to an image of `height` rows."""
    return pixels * height / REFERENCE_HEIGHT


def nearest_whole(value: float) -> int:
    """Round to the nearest whole number; halves go up."""
    return math.floor(value + 0.5)


def moved(image: Pixels, down: int, right: int) -> Pixels:
    """Move `image` (H, W) by whole pixels (negative: up, left); the edge is repeated."""
    height, width = image.shape
    rows = (np.arange(height) - down).clip(0, height - 1)
    columns = (np.arange(width) - right).clip(0, width - 1)
    return np.asarray(image[np.ix_(rows, columns)])
