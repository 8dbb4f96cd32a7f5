"""Results by region of one or more methods: heat maps of the regions."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.maps import is_around
from analysis.figures.profiles import Profile, check_one_partition
from analysis.figures.style import (
    COLUMN,
    MAP_COLOURS,
    PAGE,
    draw_borders,
    folded,
    new_figure,
    number,
    show_image,
    styled,
)
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ABREAST = 3
"""Heat maps in one row."""

NUMBER_WIDTH = 0.3
"""Inches between two numbers in a heat map that stand side by side."""


@dataclass(frozen=True)
class MethodHeatMaps:
    """Methods whose regions are painted in one scale.

    Attributes:
        region_map: (H, W) region of every pixel.
    """

    profiles: tuple[Profile, ...]
    region_map: NDArray[np.uint8]
    low: float
    high: float

    def values(self, index: int) -> NDArray[np.float64]:
        """(H, W) mIoU of the region of each pixel, percent, of method `index`."""
        return np.asarray(self.profiles[index].means[self.region_map], np.float64)


def region_heat(profiles: Sequence[Profile], image_hw: tuple[int, int]) -> MethodHeatMaps:
    """Heat maps of several methods with one scale, so that colours can be compared.

    Args:
        profiles: over one partition.
        image_hw: (H, W) of the pictures.

    Raises:
        InputError: different partitions, or an image too small for them.
    """
    from rgbt.tracking.pictures import colour_limits

    check_one_partition(profiles)
    low, high = colour_limits([mean / 100 for each in profiles for mean in each.means.tolist()])
    region_map = map_of(profiles[0].partition, image_hw)
    return MethodHeatMaps(tuple(profiles), region_map, low, high)


def staircase(region_map: NDArray[np.uint8], step: int) -> list[tuple[int, int] | None]:
    """(row, column) for the value of each region; None for an empty one.

    Rings are too narrow for numbers one above the other: they go `step` pixels further to the left
    and to the right in turn, as far as their ring reaches.
    """
    from rgbt.tracking.pictures import number_places

    places = number_places(region_map.astype(np.int64), int(region_map.max()) + 1)
    turn = 0
    for region, place in enumerate(places):
        if place is None or not is_around(region_map, region):
            continue
        column = place[1] + (turn + 1) // 2 * step * (-1) ** turn
        if 0 <= column < region_map.shape[1] and region_map[place[0], column] == region:
            places[region] = (place[0], column)
        turn += 1
    return places


@styled
def draw_heat(heat: MethodHeatMaps) -> Figure:
    """One map per method with the mIoU of each region written into it."""
    height, width = heat.region_map.shape
    columns = 2 if len(heat.profiles) == 4 else min(ABREAST, len(heat.profiles))
    rows = -(-len(heat.profiles) // columns)
    size = COLUMN if columns == 1 else PAGE
    panel = (size - 0.6) / columns
    titles = [f"{folded(each.label, panel - 0.2)}\nmIoU {each.miou:.1f}" for each in heat.profiles]
    lines = 1 + max(title.count("\n") for title in titles)
    figure = new_figure(size, rows * (panel * height / width + 0.06 + 0.14 * lines) + 0.05)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    places = staircase(heat.region_map, round(NUMBER_WIDTH * width / panel))
    for index, (axes, each) in enumerate(zip(panels, heat.profiles, strict=False)):
        how = {"cmap": MAP_COLOURS, "vmin": heat.low, "vmax": heat.high}
        shown = show_image(axes, heat.values(index), **how)
        draw_borders(axes, heat.region_map)
        for place, value in zip(places, each.means, strict=True):
            if place is not None:
                number(axes, place, "-" if np.isnan(value) else f"{value:.1f}")
        axes.set_title(titles[index])
    for axes in panels[len(heat.profiles) :]:
        axes.set_axis_off()
    label = "mIoU of the region (%)"
    figure.colorbar(shown, ax=list(panels), shrink=0.85, pad=0.015, label=label)  # type: ignore[arg-type]
    return figure


def map_of(partition: str, image_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """The map of a partition by the name that counts carry ("ring5", "ring9_released_3_4").

    Raises:
        InputError: no such partition, or an image too small for it.
    """
    match = re.fullmatch(r"(ring|vertical|horizontal)(\d+)(_released_3_4)?", partition)
    if match is None:
        raise InputError(f"'{partition}' is not a partition; expected a name such as ring5.")
    kind, regions, released = match.groups()
    aspect = ("released_3_4" if released else "image") if kind == "ring" else None
    made = Regions(partition=kind, regions=int(regions), aspect=aspect, absent="released")  # type: ignore[arg-type]
    return made.map(image_hw)
