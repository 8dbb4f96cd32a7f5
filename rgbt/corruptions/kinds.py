"""The corruptions, which change the pixels of a pair or show the thermal image of another frame.

Severity 0 is the clean image and never reaches a corruption: `rgbt.evaluation.request` returns such
samples as they are. Lengths are given in pixels of an image of `REFERENCE_HEIGHT` rows and scaled
to the height of the file, so that one ladder serves MFNet (480), PST900 (720) and the embedded data
(120).

Frames are counted in the order of the split list, separately by day and by night if the data set
distinguishes them. A list that leaves frames out (as those of the published data sets do) makes a
step of one longer than the time between two frames of the camera.
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

REFERENCE_HEIGHT = 480
"""Rows of the images that lengths in pixels are given for: MFNet's."""

Pixels = NDArray[np.uint8]
Image = Literal["rgb", "thermal"]
Images = Literal["rgb", "thermal", "both"]
"""Which image of a pair is corrupted."""

NAMES: dict[Images, str] = {"rgb": "RGB", "thermal": "thermal", "both": "RGB and thermal"}
"""Names in tables and figures."""

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""(rows, columns): up, down, left, right."""

RngOf = Callable[[str], np.random.Generator]
"""Purpose -> generator of a sample. It does not depend on the severity: a higher one hides the
same blocks and more, so that the severities of a ladder differ in nothing else."""

Severities = Annotated[
    tuple[Annotated[float, Interval(gt=0, le=1000)], ...],
    Len(1, 100),
    Predicate(lambda ladder: all(a < b for a, b in zip(ladder, ladder[1:], strict=False))),
    doc("rising numbers above 0, the clean image, which is always measured"),
]


class Kind(Protocol):
    """Members that every corruption declares."""

    @property
    def title(self) -> str:
        """Name in tables and figures, e.g. "noise, RGB"."""
        ...

    @property
    def unit(self) -> str:
        """Of the severity, e.g. "grey levels (std)"; "" where there is one severity alone."""
        ...

    @property
    def severities(self) -> tuple[float, ...]:
        """Its severities, rising; `rgbt robustness` measures all of them."""
        ...

    def check(self, severity: float) -> None:
        """InputError where `severity` (> 0) is out of range."""
        ...


class OfPixels(Kind, Protocol):
    """A corruption that changes the pixels of one pair."""

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """The corrupted `sample`, uint8 as before; the label and the name stay.

        Raises:
            InputError: the severity changes nothing of an image of this size.
        """
        ...


@runtime_checkable
class OfTime(Kind, Protocol):
    """A corruption that shows the thermal image of another frame."""

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`; 0 is the first frame."""
        ...


Corruption = OfPixels | OfTime


@dataclass(frozen=True, kw_only=True)
class Ladder:
    """What the corruptions share: severities between two bounds, here in the unit of a subclass."""

    severities: Severities
    unit: ClassVar[str]
    bounds: ClassVar[tuple[float, float]]

    def __post_init__(self) -> None:
        for severity in self.severities:
            self.check(severity)

    def check(self, severity: float) -> None:
        """InputError for a severity out of the bounds."""
        check_range(f"severity ({self.unit})", severity, *self.bounds)


@dataclass(frozen=True, kw_only=True)
class _Pixels(Ladder):
    """A corruption of RGB, of thermal, or of both (`image`)."""

    image: Images
    name: ClassVar[str]

    @property
    def title(self) -> str:
        """Its name and the image."""
        return f"{self.name}, {NAMES[self.image]}"

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        changed = {
            image: self._changed(getattr(sample, image), severity, rng_of, image)
            for image in (("rgb", "thermal") if self.image == "both" else (self.image,))
        }
        return replace(sample, **changed)  # type: ignore[arg-type]

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class Occluded(_Pixels):
    """A share of the square blocks of the image is black (0, see `Removed`).

    The blocks lie on a grid from the top left; those at the right and at the bottom may be cut.
    Exactly the nearest whole number to ``share x blocks`` is hidden, drawn without replacement.
    With ``image: both`` the same blocks are hidden in RGB and in thermal: nothing is left to see
    there. `block` is the side of a block in pixels at 480 rows; at least 1 pixel.
    """

    block: Annotated[int, Interval(ge=1, le=REFERENCE_HEIGHT)]
    name, unit, bounds = "occluded", "share of blocks", (0, 1)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        del image  # the same generator for both, so that the same blocks are hidden
        pixels = pixels.copy()
        pixels[self.hidden(pixels.shape[:2], severity, rng_of("occluded"))] = 0
        return pixels

    def hidden(
        self, image_hw: tuple[int, ...], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """(H, W): which pixels are hidden; those of a smaller share and more."""
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
    """Gaussian noise on every pixel and channel, independent, rounded and cut at 0 and 255.

    Cutting makes it smaller where the image is nearly black or white.
    """

    name, unit, bounds = "noise", "grey levels (std)", (0, 255)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        noise = rng_of(f"noise {image}").standard_normal(pixels.shape, dtype=np.float32)
        return np.rint(pixels + np.float32(severity) * noise).clip(0, 255).astype(np.uint8)


@dataclass(frozen=True, kw_only=True)
class Blur(_Pixels):
    """Gaussian blur; the image is mirrored at its edges."""

    name, unit, bounds = "blur", "pixels at 480 rows (sigma)", (0, REFERENCE_HEIGHT / 4)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: str) -> Pixels:
        del rng_of, image  # nothing is drawn
        sigma = at_height(severity, pixels.shape[0])
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), np.uint8)


@dataclass(frozen=True, kw_only=True)
class Removed:
    """One image of the pair is black: every pixel 0 in the file's grey levels.

    That is before the normalisation, so what a network sees depends on its inputs
    (``conf/model/inputs/``): 0 for RTFNet and MFNet (``unit``) and for CMX as the Temporal release
    feeds it (``temporal``; a thermal image of zeros has no maximum to be divided by and stays 0);
    -2.12, -2.04, -1.80 in R, G, B and -2.12 in thermal for CRM and SpatialSeg (``crm``), the same
    three values in RGB and thermal for CMX as its release feeds it (``cmx``); -1 for HeatNet and
    the thesis (``half``, ``half_three``). Masked cells of a training are different: the networks of
    CRM replace them by a learned token, so that a black image is nothing they were trained on.

    CRM, Table 1 ("RGB drop", "THR drop") does not say how an image is dropped, and no release shows
    it. For a network that always decodes both images a black one is the only way; those that decode
    the features of a single branch have it as another test (``modality=thermal``).
    """

    image: Image
    severities: ClassVar[tuple[float, ...]] = (1.0,)
    unit: ClassVar[str] = ""

    @property
    def title(self) -> str:
        """The missing image."""
        return f"{NAMES[self.image]} removed (zeroed)"

    def check(self, severity: float) -> None:
        """An image is missing or not."""
        check_range("severity", severity, 1, 1)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`."""
        del severity, rng_of  # there is one way to be missing
        black = {self.image: np.zeros_like(getattr(sample, self.image))}
        return replace(sample, **black)


@dataclass(frozen=True, kw_only=True)
class Misregistered(Ladder):
    """Thermal is moved by n pixels up, down, left or right, as drawn for each image.

    Whole pixels, so that nothing is interpolated and the effect is that of the position alone. What
    comes in from outside repeats the edge: a black stripe would be a corruption of its own. The
    colour image and the label stay.
    """

    title: ClassVar[str] = "misregistered thermal"
    unit, bounds = "pixels at 480 rows", (0, REFERENCE_HEIGHT / 2)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`; InputError where the distance is less than half a pixel of the file."""
        height = sample.thermal.shape[0]
        distance = nearest_whole(at_height(severity, height))
        if distance == 0:
            raise InputError(f"severity: {severity:g} is below half a pixel of {height} rows.")
        rows, columns = DIRECTIONS[int(rng_of("misregistered").integers(len(DIRECTIONS)))]
        return replace(sample, thermal=moved(sample.thermal, rows * distance, columns * distance))


@dataclass(frozen=True, kw_only=True)
class Delayed(Ladder):
    """The thermal image is that of n frames earlier; the first n frames show the first one."""

    title: ClassVar[str] = "delayed thermal"
    unit, bounds = "frames", (1, 1000)

    def check(self, severity: float) -> None:
        """InputError but for whole frames."""
        super().check(severity)
        if not severity.is_integer():
            raise InputError(f"severity: expected a number of frames, got {severity:g}.")

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`."""
        return max(0, index - int(severity))


@dataclass(frozen=True, kw_only=True)
class Frozen(Delayed):
    """The thermal image stands still and is renewed every n frames.

    Frame i shows the thermal image of frame ``i - i mod n``: one frame in n is right, the others
    are 1 to n - 1 frames old.
    """

    title: ClassVar[str] = "frozen thermal"
    unit, bounds = "frames between two images", (2, 1000)

    def shown(self, index: int, severity: float) -> int:
        """Index of the frame whose thermal image is shown at `index`."""
        return index - index % int(severity)


def at_height(pixels: float, height: int) -> float:
    """A length of the reference height as a length of an image of `height` rows."""
    return pixels * height / REFERENCE_HEIGHT


def nearest_whole(value: float) -> int:
    """The nearest whole number; halves go up."""
    return math.floor(value + 0.5)


def moved(image: Pixels, down: int, right: int) -> Pixels:
    """(H, W) `image` moved by whole pixels (negative: up, left); the edge is repeated."""
    rows, columns = (
        np.arange(size) - by for size, by in zip(image.shape, (down, right), strict=True)
    )
    height, width = image.shape
    return np.asarray(image[np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))])
