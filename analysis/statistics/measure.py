"""One image measured by region: labels, Laplacian variance, mean value and noise.

Everything is whole numbers until the last division, so that the order of sums does not matter.
"""

from __future__ import annotations

import math
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import check_choice
from rgbt.types import IGNORE, Sample

# Ways to estimate the noise of Eq. 4, which the paper leaves open. The first is the default: it
# uses every pixel, is unbiased for normal noise, and is fine-grained on 8-bit images.
#
# immerkaer: Immerkaer (1996), "Fast noise variance estimation": mean of |I * N| times
#     sqrt(pi / 2) / 6. N is the difference of two Laplacians, which does not respond to planes and
#     to straight edges along the axes.
# wavelet_mad: Donoho and Johnstone (1994): median of the diagonal Haar coefficients |HH| over
#     0.6745. Up to half of a region may be texture. `grouped_median` interpolates the median,
#     because the median of whole numbers is coarse.
# std: standard deviation of the pixel values of the region. All structure counts as noise. It is
#     here because papers use it.
ESTIMATORS = ("immerkaer", "wavelet_mad", "std")

# Neighbours that the Laplacian reads. Four is the default: Pertuz et al., whom the paper cites
# for this measure, and `cv2.Laplacian` use it by default.
KERNELS = ("four", "eight")

EIGHT = np.array([[1, 1, 1], [1, -8, 1], [1, 1, 1]], np.float32)
# Immerkaer's mask N is its outer product with itself.
SECOND_DIFFERENCE = np.array([1, -2, 1], np.float32)

# Median of ``|x|`` for a standard normal x.
MEDIAN_OF_NORMAL = 0.6744897501960817

# Number of values of |a - b - c + d| of four bytes, which is twice the Haar coefficient HH.
HAAR_BINS = 2 * 255 + 1

Image = NDArray[np.uint8]
Ints = NDArray[np.int64]
Floats = NDArray[np.float64]


class ImageMeter:
    """Measures images of one size; what depends on the regions alone is computed once.

    Args:
        region_map: (H, W) uint8, region index 0..R-1; every region holds a pixel.
        num_classes: K.
        kernel: one of `KERNELS`.

    Raises:
        InputError: unknown kernel.
    """

    def __init__(self, region_map: Image, num_classes: int, kernel: str = KERNELS[0]) -> None:
        check_choice("kernel", kernel, KERNELS)
        self._map = region_map
        self._num_classes = num_classes
        self._kernel = kernel
        # Runs of pixels of one region, in the order in which an image lies in memory.
        flat = region_map.ravel()
        self._begins = np.append(True, flat[1:] != flat[:-1])
        self._starts = np.flatnonzero(self._begins)
        self._owner = flat[self._starts]
        self.num_regions = int(region_map.max()) + 1
        self._pixels = np.bincount(region_map.ravel()).astype(np.float64)
        inner = np.zeros(region_map.shape, np.int32)
        inner[1:-1, 1:-1] = 1
        self._inner = self._sums(inner)
        height, width = region_map.shape
        # A block of 2x2 pixels belongs to the region of its first pixel.
        corners = region_map[0 : height - 1 : 2, 0 : width - 1 : 2]
        self._block_bins = corners.astype(np.intp) * HAAR_BINS

    def __call__(self, sample: Sample) -> dict[str, NDArray[Any]]:
        """Measure one labelled pair of the size of the region map.

        Returns labels, ignored, laplacian, mean and noise: the arrays of
        `analysis.statistics.collect.SpatialStatistics` without the axis of the images.
        """
        assert sample.label is not None, "only labelled samples are measured"
        labels, ignored = self.count_labels(sample.label)
        grey = cv2.cvtColor(sample.rgb, cv2.COLOR_RGB2GRAY)
        by_image = [self.measure(np.asarray(grey, np.uint8)), self.measure(sample.thermal)]
        laplacian, mean, *noise = np.stack(by_image, axis=1)
        return {
            "labels": labels,
            "ignored": ignored,
            "laplacian": laplacian,
            "mean": mean,
            "noise": np.stack(noise),
        }

    def measure(self, image: Image) -> Floats:
        """Return (2 + E, R): Laplacian variance, mean, and noise by all of `ESTIMATORS`."""
        _, laplacian = self._mean_and_variance(self._laplacian(image))
        mean, variance = self._mean_and_variance(image)
        noise = self._immerkaer(image), self._wavelet_mad(image), np.sqrt(variance)
        return np.stack([laplacian, mean, *noise])

    def count_labels(self, label: Image) -> tuple[Ints, Ints]:
        """Count pixels by region and class, (R, K), and ignored ones, (R,)."""
        flat = label.ravel()
        # Labels are large areas: a few thousand runs of one region and class instead of pixels.
        begins = self._begins.copy()
        begins[1:] |= flat[1:] != flat[:-1]
        starts = np.flatnonzero(begins)
        lengths = np.diff(starts, append=flat.size)
        known = self._num_classes
        column = flat[starts].astype(np.intp)
        column[column == IGNORE] = known
        bins = self._map.ravel()[starts] * np.intp(known + 1) + column
        counts = np.bincount(bins, weights=lengths, minlength=self.num_regions * (known + 1))
        table = counts.astype(np.int64).reshape(self.num_regions, known + 1)
        return table[:, :known], table[:, known]

    def _sums(self, values: NDArray[np.int32]) -> Floats:
        """Add (H, W) values up to (R,) sums; whole, kept as float64."""
        along = np.add.reduceat(values.ravel(), self._starts, dtype=np.int64)
        return np.asarray(np.bincount(self._owner, weights=along), np.float64)

    def _laplacian(self, image: Image) -> NDArray[np.int16]:
        """Return whole numbers; the border is mirrored (OpenCV's default), so no pixel is lost."""
        if self._kernel == "four":
            return np.asarray(cv2.Laplacian(image, cv2.CV_16S, ksize=1), np.int16)
        return np.asarray(cv2.filter2D(image, cv2.CV_16S, EIGHT), np.int16)

    def _mean_and_variance(self, values: NDArray[np.integer]) -> tuple[Floats, Floats]:
        wide = values.astype(np.int32)
        mean = self._sums(wide) / self._pixels
        np.multiply(wide, wide, out=wide)
        return mean, self._sums(wide) / self._pixels - mean**2

    def _immerkaer(self, image: Image) -> Floats:
        kernel = SECOND_DIFFERENCE
        response = np.abs(cv2.sepFilter2D(image, cv2.CV_16S, kernel, kernel)).astype(np.int32)
        # The mask has to fit into the image, as published.
        response[[0, -1]] = 0
        response[:, [0, -1]] = 0
        with np.errstate(invalid="ignore"):
            mean = self._sums(response) / self._inner
        return np.asarray(math.sqrt(math.pi / 2) / 6 * mean)

    def _wavelet_mad(self, image: Image) -> Floats:
        height, width = image.shape
        even = image[: height // 2 * 2, : width // 2 * 2].astype(np.int16)
        across = even[:, 0::2] - even[:, 1::2]
        twice_hh = np.abs(across[0::2] - across[1::2])
        histogram = np.bincount(
            (self._block_bins + twice_hh).ravel(), minlength=self.num_regions * HAAR_BINS
        )
        median = grouped_median(histogram.reshape(self.num_regions, HAAR_BINS))
        return median / 2 / MEDIAN_OF_NORMAL


def grouped_median(histogram: NDArray[np.integer]) -> Floats:
    """Return the median of rounded magnitudes, interpolated inside the bin that it falls into.

    Bin 0 stands for [0, 0.5), bin k for [k - 0.5, k + 0.5). Without this, a median of whole numbers
    can be wrong by half a bin: for normal noise of one grey level the estimate would be 0.74. Even
    a constant region gets 0.19 grey levels, less than what rounding to 8 bits adds (0.29).

    Args:
        histogram: (R, bins) how often each magnitude occurs.

    Returns:
        (R,) medians; NaN for an empty row.
    """
    half = histogram.sum(1) / 2
    upto = histogram.cumsum(1)
    index = np.argmax(upto >= half[:, None], axis=1)
    rows = np.arange(len(histogram))
    inside = histogram[rows, index]
    below = upto[rows, index] - inside
    with np.errstate(invalid="ignore", divide="ignore"):
        share = (half - below) / inside
    lower = np.maximum(index - 0.5, 0.0)
    return np.asarray(np.where(inside > 0, lower + (index + 0.5 - lower) * share, np.nan))
