"""Corruptions of the pixels of one pair: missing, hidden, noisy, out of focus or misregistered."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import cv2
import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, check_range
from rgbt.corruptions.corruption import (
    IMAGES,
    NAMES,
    REFERENCE_HEIGHT,
    Image,
    Images,
    RngOf,
    Severities,
    at_height,
    check_ladder,
    nearest_whole,
)
from rgbt.types import Sample

Pixels = NDArray[np.uint8]

DIRECTIONS = ((-1, 0), (1, 0), (0, -1), (0, 1))
"""(rows, columns): up, down, left, right."""


class OneOrBoth:
    """Base of corruptions that change the pixels of RGB, of thermal, or of both.

    Args:
        image: which of them.
        severities: the ladder, in the unit of the subclass.

    Raises:
        InputError: a severity out of range.
    """

    name: str
    unit: str
    measure: str
    highest: float
    """Meaning of the severity, and the highest value."""

    def __init__(self, *, image: Images, severities: Severities) -> None:
        self.image: Images = image
        self.severities = severities
        self.title = f"{self.name}, {NAMES[image]}"
        check_ladder(self)

    def check(self, severity: float) -> None:
        """InputError unless `severity` is above 0 and up to `highest`."""
        check_range(f"severity ({self.measure})", severity, 0, self.highest)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """The corrupted `sample`, see `rgbt.corruptions.corruption.OfPixels`."""
        changed: dict[str, Any] = {
            image: self._changed(getattr(sample, image), severity, rng_of, image)
            for image in IMAGES[self.image]
        }
        return replace(sample, **changed)

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: Image) -> Pixels:
        raise NotImplementedError


class Occluded(OneOrBoth):
    """A share of the square blocks of the image is black (0, see `Removed`).

    The blocks lie on a grid from the top left; those at the right and at the bottom may be cut.
    Exactly the nearest whole number to ``share x blocks`` is hidden, drawn without replacement.
    With ``image: both`` the same blocks are hidden in RGB and in thermal: nothing is left to see
    there.

    Args:
        image: where blocks are hidden.
        block: side of a block in pixels at 480 rows (`REFERENCE_HEIGHT`); at least 1 pixel.
        severities: shares, 0..1.
    """

    name, unit = "occluded", "share of blocks"
    measure, highest = unit, 1

    def __init__(
        self,
        *,
        image: Images,
        block: Annotated[int, Interval(ge=1, le=REFERENCE_HEIGHT)],
        severities: Severities,
    ) -> None:
        super().__init__(image=image, severities=severities)
        self.block = block

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: Image) -> Pixels:
        del image  # the same generator for both, so that the same blocks are hidden
        hidden = self.hidden(pixels.shape[:2], severity, rng_of("occluded"))
        pixels = pixels.copy()
        pixels[hidden] = 0
        return pixels

    def hidden(
        self, image_hw: tuple[int, ...], share: float, rng: np.random.Generator
    ) -> NDArray[np.bool_]:
        """(H, W): which pixels are hidden; those of a smaller share and more.

        Raises:
            InputError: the share is less than half a block.
        """
        height, width = image_hw
        side = max(1, nearest_whole(at_height(self.block, height)))
        rows, columns = -(-height // side), -(-width // side)
        number = nearest_whole(share * rows * columns)
        if number == 0:
            raise InputError(
                f"a share of {share:g} of {rows} x {columns} blocks hides no block; give a "
                f"severity of at least {0.5 / (rows * columns):.2g}, or a smaller "
                "corruption.block."
            )
        blocks = np.zeros(rows * columns, bool)
        blocks[rng.permutation(rows * columns)[:number]] = True
        grid = blocks.reshape(rows, columns).repeat(side, 0).repeat(side, 1)
        return np.asarray(grid[:height, :width])


class Noise(OneOrBoth):
    """Gaussian noise on every pixel and channel, independent, rounded and cut at 0 and 255.

    Cutting makes it smaller where the image is nearly black or white. Severities are standard
    deviations in grey levels (0..255).
    """

    name, unit = "noise", "grey levels (std)"
    measure, highest = "standard deviation in grey levels", 255

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: Image) -> Pixels:
        noise = rng_of(f"noise {image}").standard_normal(pixels.shape, dtype=np.float32)
        return np.rint(pixels + np.float32(severity) * noise).clip(0, 255).astype(np.uint8)


class Blur(OneOrBoth):
    """Gaussian blur; the image is mirrored at its edges.

    Severities are standard deviations in pixels at 480 rows (`REFERENCE_HEIGHT`).
    """

    name, unit = "blur", "pixels at 480 rows (sigma)"
    measure, highest = "sigma in pixels", REFERENCE_HEIGHT / 4

    def _changed(self, pixels: Pixels, severity: float, rng_of: RngOf, image: Image) -> Pixels:
        del rng_of, image  # nothing is drawn
        sigma = at_height(severity, pixels.shape[0])
        return np.asarray(cv2.GaussianBlur(pixels, (0, 0), sigma), np.uint8)


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

    Args:
        image: which one is missing.
    """

    unit = ""
    severities = (1.0,)

    def __init__(self, *, image: Image) -> None:
        self.image: Image = image
        self.title = f"{NAMES[image]} removed (zeroed)"

    def check(self, severity: float) -> None:
        """An image is missing or not."""
        if severity != 1:
            raise InputError(f"the severity of a missing image must be 1, got {severity:g}.")

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """The corrupted `sample`, see `rgbt.corruptions.corruption.OfPixels`."""
        del severity, rng_of  # there is one way to be missing
        black: dict[str, Any] = {self.image: np.zeros_like(getattr(sample, self.image))}
        return replace(sample, **black)


class Misregistered:
    """Thermal is moved by n pixels up, down, left or right, as drawn for each image.

    Whole pixels, so that nothing is interpolated and the effect is that of the position alone. What
    comes in from outside repeats the edge: a black stripe would be a corruption of its own. The
    colour image and the label stay.

    Args:
        severities: n in pixels at 480 rows (`REFERENCE_HEIGHT`).

    Raises:
        InputError: a severity out of range.
    """

    title = "misregistered thermal"
    unit = "pixels at 480 rows"

    def __init__(self, *, severities: Severities) -> None:
        self.severities = severities
        check_ladder(self)

    def check(self, severity: float) -> None:
        """A distance in pixels, above 0 and up to half the height."""
        check_range("severity (pixels)", severity, 0, REFERENCE_HEIGHT / 2)

    def __call__(self, sample: Sample, severity: float, rng_of: RngOf) -> Sample:
        """See `OfPixels`; InputError where the distance is less than half a pixel of the file."""
        height = sample.thermal.shape[0]
        distance = nearest_whole(at_height(severity, height))
        if distance == 0:
            raise InputError(
                f"misregistered by {severity:g} pixels at {REFERENCE_HEIGHT} rows is less than "
                f"half a pixel of an image of {height} rows; give a severity of at least "
                f"{0.5 * REFERENCE_HEIGHT / height:g}."
            )
        rows, columns = DIRECTIONS[int(rng_of("misregistered").integers(len(DIRECTIONS)))]
        return replace(sample, thermal=moved(sample.thermal, rows * distance, columns * distance))


def moved(image: Pixels, down: int, right: int) -> Pixels:
    """(H, W) `image` moved by whole pixels (negative: up, left); the edge is repeated."""
    rows, columns = (
        np.arange(size) - by for size, by in zip(image.shape, (down, right), strict=True)
    )
    height, width = image.shape
    return np.asarray(image[np.ix_(rows.clip(0, height - 1), columns.clip(0, width - 1))])
