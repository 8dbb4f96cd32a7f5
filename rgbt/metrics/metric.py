"""Partitions of an image into regions of equal area; index r is region r + 1 of the tables."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal, get_args

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError

Absent = Literal["released", "exclude"]
Partition = Literal["ring", "vertical", "horizontal"]
Aspect = Literal["image", "released_3_4"]
RegionMap = NDArray[np.uint8]
MAX_REGIONS = 255  # what bytes can number


@dataclass(frozen=True, kw_only=True)
class Regions:
    """A partition of the image, and the rule for absent classes; conf/metric/ explains the keys.

    Rings are nested rectangles, region 1 innermost, with an aspect (see `ring_map`); strips are
    numbered from left to right or from top to bottom. `absent`: see `rgbt.metrics.scores`.
    """

    partition: Partition
    regions: Annotated[int, Interval(ge=1, le=MAX_REGIONS)]
    aspect: Aspect | None
    absent: Absent

    def __post_init__(self) -> None:
        if (self.partition == "ring") != (self.aspect is not None):
            raise InputError(f"metric.aspect={self.aspect}: a ring has an aspect, a strip null.")

    @property
    def name(self) -> str:
        """Name the partition, as stored with the counts: "ring5", "ring9_released_3_4"."""
        suffix = "" if self.aspect in (None, "image") else f"_{self.aspect}"
        return f"{self.partition}{self.regions}{suffix}"

    def map(self, image_hw: tuple[int, int]) -> RegionMap:
        """Return the region of every pixel, (H, W) read-only; InputError: too small an image."""
        return _region_map(self, image_hw)


def number_of_regions(name: str) -> int:
    """Return how many regions a partition of this name has (`Regions.name`); 0: another one."""
    found = re.fullmatch(rf"({'|'.join(get_args(Partition))})(\d+)(_released_3_4)?", name)
    return int(found[2]) if found else 0


@lru_cache(maxsize=16)
def _region_map(metric: Regions, image_hw: tuple[int, int]) -> RegionMap:
    regions = metric.regions
    if metric.aspect is not None:
        found = ring_map(image_hw, regions, metric.aspect)
    else:
        found = strip_map(image_hw, regions, vertical=metric.partition == "vertical")
    if np.bincount(found.ravel(), minlength=regions).min() == 0:
        raise InputError(f"metric.regions={regions} is too many for an image of {image_hw}.")
    found.flags.writeable = False
    return found


def strip_map(image_hw: tuple[int, int], regions: int, *, vertical: bool) -> RegionMap:
    """Cut strips: pixel n of a side of length N is in region ``floor(n R / N)``; R: `regions`.

    Source: SpatialSeg, Fig. 2; the release has no strips.
    """
    length = image_hw[1] if vertical else image_hw[0]
    strip = (np.arange(length) * regions // length).astype(np.uint8)
    return np.broadcast_to(strip if vertical else strip[:, None], image_hw).copy()


def ring_map(image_hw: tuple[int, int], regions: int, aspect: Aspect) -> RegionMap:
    """Nest centred rectangles of equal area steps; index 0 is the innermost.

    The rectangle around regions 0..r-1 has the area ``r H W / R``; R is `regions`.
    Paper: SpatialSeg, Sec. IV-D and Fig. 2(c); `aspect` "image" gives the rectangles the image's
    own. Released: sides in the ratio 3:4 for every image, numbered from the outside
    ("released_3_4" is the same map with our numbers). InputError: these do not fit.
    """
    region_map = np.full(image_hw, regions - 1, np.uint8)
    for inner in range(regions - 1, 0, -1):
        rows, columns = ring_rectangle(image_hw, regions, inner, aspect)
        if rows.start < 0 or columns.start < 0:
            raise InputError(f"metric.aspect={aspect} does not fit {image_hw} pixels; use image.")
        region_map[rows, columns] = inner - 1
    return region_map


def ring_rectangle(
    image_hw: tuple[int, int], regions: int, inner: int, aspect: Aspect
) -> tuple[slice, slice]:
    """Return rows and columns, half open, of the rectangle around the `inner` innermost regions.

    Its sides are ``H sqrt(r / R)`` and ``W sqrt(r / R)`` ("image"), or ``3 s`` and ``4 s`` with
    ``12 s^2 = r H W / R`` ("released_3_4"); bounds are cut to integers as in the SpatialSeg
    release. Squares are kept as whole fractions: no rounding decides where an edge falls.
    """
    height, width = image_hw
    if aspect == "image":
        squares = (height * height * inner, regions), (width * width * inner, regions)
    else:
        area = inner * height * width
        squares = (3 * area, 4 * regions), (4 * area, 3 * regions)
    return _centred(height, *squares[0]), _centred(width, *squares[1])


def _centred(length: int, numerator: int, denominator: int) -> slice:
    """Compute ``floor((length -+ sqrt(numerator / denominator)) / 2)`` exactly."""
    floor_side = math.isqrt(numerator // denominator)
    exact = floor_side * floor_side * denominator == numerator
    ceil_side = floor_side if exact else floor_side + 1
    return slice((length - ceil_side) // 2, (length + floor_side) // 2)
