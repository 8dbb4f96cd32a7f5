"""The partition of the image and the rule for absent classes, configured by conf/metric/."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.metrics.regions import (
    MAX_REGIONS,
    Aspect,
    Partition,
    RegionMap,
    ring_map,
    strip_map,
)

Absent = Literal["released", "exclude"]


@dataclass(frozen=True, kw_only=True)
class Regions:
    """A partition of the image, and the rule for classes that are absent in a region.

    Attributes:
        partition: "ring" nested rectangles, region 1 innermost; "vertical" strips from left to
            right; "horizontal" strips from top to bottom.
        regions: number of regions of equal area, 1..255.
        aspect: of the rings: "image" or "released_3_4" (see `rgbt.metrics.regions.ring_map`);
            None for strips, which have none.
        absent: score of a class without a pixel to count: "released" 0, "exclude" left out of
            the mean (see `rgbt.metrics.scores`).

    Raises:
        InputError: a number out of range, or an aspect where it cannot take effect.
    """

    partition: Partition
    regions: Annotated[int, Interval(ge=1, le=MAX_REGIONS)]
    aspect: Aspect | None
    absent: Absent

    def __post_init__(self) -> None:
        if (self.partition == "ring") != (self.aspect is not None):
            wanted = "image or released_3_4" if self.partition == "ring" else "null"
            raise InputError(
                f"metric.aspect must be {wanted} with metric.partition={self.partition}, "
                f"got {self.aspect or 'null'}."
            )

    @property
    def name(self) -> str:
        """Short name of the partition, stored with the counts: "ring5", "ring9_released_3_4"."""
        suffix = "_released_3_4" if self.aspect == "released_3_4" else ""
        return f"{self.partition}{self.regions}{suffix}"

    def map(self, image_hw: tuple[int, int]) -> RegionMap:
        """(H, W) uint8 region index of every pixel, read-only, computed once per image size.

        Raises:
            InputError: the image is too small for so many regions.
        """
        return _region_map(self.partition, self.regions, self.aspect, image_hw)


@lru_cache(maxsize=16)
def _region_map(
    partition: Partition, regions: int, aspect: Aspect | None, image_hw: tuple[int, int]
) -> RegionMap:
    if aspect is not None:
        return ring_map(image_hw, regions, aspect)
    return strip_map(image_hw, regions, vertical=partition == "vertical")
