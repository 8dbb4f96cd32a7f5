"""Partitions of an image into regions of equal area, as index maps.

Index r of a map is region r + 1 of the tables. Pure functions; the configured choice is
`rgbt.metrics.metric.Regions`.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError

Partition = Literal["ring", "vertical", "horizontal"]
Aspect = Literal["image", "released_3_4"]
RegionMap = NDArray[np.uint8]
"""(H, W): region index 0..R-1 of every pixel."""

MAX_REGIONS = 255
"""What the bytes of a `RegionMap` can number."""


def strip_map(image_hw: tuple[int, int], regions: int, *, vertical: bool) -> RegionMap:
    """Strips of equal width (``vertical``, left to right) or height (top to bottom).

    Pixel n of a side of length N lies in region ``floor(n R / N)``, so that widths differ by at
    most one pixel; R is `regions`. Source: SpatialSeg, Fig. 2; the release has no strips.

    Raises:
        InputError: fewer pixels across than regions.
    """
    height, width = image_hw
    length = width if vertical else height
    strip = (np.arange(length) * regions // length).astype(np.uint8)
    region_map = np.broadcast_to(strip if vertical else strip[:, None], (height, width))
    return _checked(np.ascontiguousarray(region_map), regions)


def ring_map(image_hw: tuple[int, int], regions: int, aspect: Aspect) -> RegionMap:
    """Nested centred rectangles of equal area steps; index 0 is the innermost.

    The rectangle around regions 0..r-1 has the area ``r H W / R``; R is `regions`.
    Paper: SpatialSeg, Sec. IV-D and Fig. 2(c); region 1 is the centre; `aspect` "image" gives the
    rectangles the image's own. Released: sides in the ratio 3:4 for every image, numbered from the
    outside ("released_3_4" is the same map with our numbers). For images of 3:4 both are equal.

    Raises:
        InputError: the released rectangles do not fit into the image, or a region is empty.
    """
    height, width = image_hw
    region_map = np.full(image_hw, regions - 1, np.uint8)
    for inner in range(regions - 1, 0, -1):
        rows, columns = ring_rectangle(image_hw, regions, inner, aspect)
        if rows.start < 0 or columns.start < 0:
            raise InputError(
                f"metric.aspect=released_3_4: the rectangle around region {inner} of {regions} "
                f"does not fit into {height}x{width} pixels; use metric.aspect=image."
            )
        region_map[rows, columns] = inner - 1
    return _checked(region_map, regions)


def ring_rectangle(
    image_hw: tuple[int, int], regions: int, inner: int, aspect: Aspect
) -> tuple[slice, slice]:
    """Rows and columns, half open, of the rectangle around the `inner` innermost regions.

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
    """``floor((length -+ sqrt(numerator / denominator)) / 2)``, exactly."""
    floor_side = math.isqrt(numerator // denominator)
    exact = floor_side * floor_side * denominator == numerator
    ceil_side = floor_side if exact else floor_side + 1
    return slice((length - ceil_side) // 2, (length + floor_side) // 2)


def _checked(region_map: RegionMap, regions: int) -> RegionMap:
    """`region_map`, read-only, if it holds every region."""
    if np.bincount(region_map.ravel(), minlength=regions).min() == 0:
        raise InputError(
            f"metric.regions={regions} is too many for an image of "
            f"{region_map.shape[0]}x{region_map.shape[1]} pixels; use fewer regions."
        )
    region_map.flags.writeable = False
    return region_map
