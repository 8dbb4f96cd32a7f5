"""SpatialSeg, Figs. 1 and 4: heat maps over pixel positions, and the regions drawn on a picture.

The paper does not state how large its "centre" and its "edge" are, nor how its numbers come from
its map. Here centre and edge are the innermost and the outermost ring of the partition, which
the figure names and which can be changed with ``metric=``; and the numbers are those of the tables:
of (a) the regional mIoU, of (b) the sample occupancy rate, both from the pixels of a ring added up
over all images before anything is divided. They are not means over the pixels of the map.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput
from analysis.predictions.maps import PixelMaps, iou_map
from analysis.statistics.data import ALL, SpatialStatistics
from analysis.statistics.derive import check_background, occupancy_map, occupancy_of
from rgbt.checks import InputError
from rgbt.metrics.metric import Regions
from rgbt.metrics.scores import class_mean
from rgbt.tracking.pictures import number_places


@dataclass(frozen=True)
class HeatMap:
    """A value at every pixel position, and the three numbers of Fig. 1.

    Attributes:
        source: what it is of: a method or a data set, its split, and which images of it.
        measure: what the three numbers are, for the caption.
        values: (H, W) in 0..1; NaN: nothing to score at that position.
        centre: of the innermost region, 0..1.
        edge: of the outermost region, 0..1.
        whole: of the whole image, 0..1.
        region_map: (H, W) region of every pixel.
    """

    what: str
    source: str
    measure: str
    values: NDArray[np.float64]
    centre: float
    edge: float
    whole: float
    region_map: NDArray[np.uint8]
    partition: str


def make_heats(given: FigureInput) -> Figure:
    """Heat maps of IoU and of sample occupancy."""
    has_statistics = "statistics" in given.values or given.has_dataset
    if "maps" not in given.values and not has_statistics:
        raise InputError(
            f"figure={given.figure} needs maps=... (folder of rgbt score) for the "
            "IoU, statistics=... (of rgbt spatial) or dataset=... for the sample "
            "occupancy, or both."
        )
    if not has_statistics:
        given.refuse(["part"], "statistics=... or dataset=..., whose images it selects")
    heats, part = [], given.get("part", ALL)
    if "maps" in given.values:
        pixel_maps = given.maps()
        if not has_statistics:
            given.check_split(pixel_maps.split, given.values["maps"])
        heats.append(iou_heat(pixel_maps, given.regions, beside_part=part != ALL))
    else:
        given.refuse(["metric.absent"], "maps=...")
    if has_statistics:
        heats.append(occupancy_heat(given.statistics(), given.regions, part))
    return draw_heats(heats)


def make_regions(given: FigureInput) -> Figure:
    """A partition over a heat map or an image."""
    sources = [key for key in ("maps", "statistics") if key in given.values]
    if len(sources) + given.has_dataset != 1:
        raise InputError(
            f"figure={given.figure} needs one picture: maps=... (folder of rgbt score), "
            "statistics=... (of rgbt spatial), or dataset=... for its first image or that of "
            "names=..."
        )
    picture: NDArray[Any]
    what = ""
    if given.has_dataset:
        picture = given.dataset.read(given.name()).rgb
    else:
        given.refuse(["names"], "dataset=...")
        if sources == ["maps"]:
            pixel_maps = given.maps()
            given.check_split(pixel_maps.split, given.values["maps"])
            picture, what = iou_map(pixel_maps), f"IoU ({pixel_maps.name}, {pixel_maps.split})"
        else:
            statistics = given.statistics()
            picture, what = occupancy_map(statistics), f"sample occupancy ({statistics.split})"
    region_map = given.regions.map((picture.shape[0], picture.shape[1]))
    return draw_regions(picture, region_map, what)


def iou_heat(maps: PixelMaps, regions: Regions, *, beside_part: bool = False) -> HeatMap:
    """Pixel-level IoU, mean over classes (Fig. 1a).

    The map itself excludes classes that never occur at a pixel, see
    `analysis.predictions.maps.iou_map`.

    Args:
        maps: intersections and unions of a method's predictions, all images together.
        regions: a partition into rings, and how a class counts that a ring lacks.
        beside_part: the map beside it is of day or night alone, so that this one says "all images".

    Raises:
        InputError: a partition that has no centre.
    """
    region_map = ring_map(regions, maps.intersection.shape[1:])

    def pooled(chosen: NDArray[np.bool_]) -> float:
        right = maps.intersection[:, chosen].sum(1, dtype=np.int64)
        either = maps.union[:, chosen].sum(1, dtype=np.int64)
        nothing = 0.0 if regions.absent == "released" else np.nan
        ious = np.where(either > 0, right / np.maximum(either, 1), nothing)
        return float(class_mean(ious, maps.scored))

    return HeatMap(
        what="IoU",
        source=f"{maps.name}, {maps.split}" + (", all images" if beside_part else ""),
        measure="mIoU",
        values=iou_map(maps),
        centre=pooled(region_map == 0),
        edge=pooled(region_map == regions.regions - 1),
        whole=pooled(np.ones_like(region_map, bool)),
        region_map=region_map,
        partition=regions.name,
    )


def occupancy_heat(statistics: SpatialStatistics, regions: Regions, part: str = ALL) -> HeatMap:
    """Sample occupancy rate (Fig. 1b; Eq. 1), with its mean over rings (Eq. 2).

    Args:
        statistics: of a data set, with any partition.
        regions: a partition into rings.
        part: "all", "day" or "night".

    Raises:
        InputError: a partition that has no centre, a part that the data set does not hold, or a
            data set without a background class.
    """
    values = occupancy_map(statistics, part)
    region_map = ring_map(regions, values.shape)
    by_region = occupancy_over(statistics, region_map, part)
    whole = occupancy_over(statistics, np.zeros_like(region_map), part)
    return HeatMap(
        what="sample occupancy",
        source=f"{statistics.dataset}, {statistics.split}" + ("" if part == ALL else f", {part}"),
        measure="SOR",
        values=values,
        centre=float(by_region[0]),
        edge=float(by_region[-1]),
        whole=float(whole[0]),
        region_map=region_map,
        partition=regions.name,
    )


def occupancy_over(
    statistics: SpatialStatistics, region_map: NDArray[np.uint8], part: str = ALL
) -> NDArray[np.float64]:
    """Sample occupancy rate (Eq. 2) over any regions, also others than were measured.

    Returns:
        (R,) in 0..1, as `analysis.statistics.derive.region_occupancy` for the measured regions.

    Raises:
        InputError: the data set has no background class.
    """
    check_background(statistics)
    occupied = statistics.select(part).occupied.sum(0)
    index = region_map.ravel()
    pixels = [np.bincount(index, of_class.ravel()) for of_class in occupied]
    return occupancy_of(np.stack(pixels, axis=1), statistics.is_background)


def ring_map(regions: Regions, image_hw: Sequence[int]) -> NDArray[np.uint8]:
    """The map of a partition that has a centre; InputError where it has none."""
    if regions.partition != "ring":
        raise InputError(
            f"metric.partition={regions.partition} has no centre and no edge; use rings, for "
            "example metric=ring5."
        )
    return regions.map((image_hw[0], image_hw[1]))


@style.styled
def draw_heats(heats: Sequence[HeatMap]) -> Figure:
    """One panel per map with its three numbers, and one scale from 0 to 1 for all (Fig. 1)."""
    wide = len(heats) > 1
    height, width = heats[0].values.shape
    panel = (style.PAGE - 0.8) / len(heats) if wide else style.COLUMN - 0.6
    figure = style.new_figure(style.PAGE if wide else style.COLUMN, panel * height / width + 0.62)
    panels = figure.subplots(1, len(heats), squeeze=False)[0]
    for index, (axes, heat) in enumerate(zip(panels, heats, strict=True)):
        shown = style.show_image(axes, heat.values, cmap=style.MAP_COLOURS, vmin=0, vmax=1)
        # The borders of centre and edge alone: 0 centre, 1 between, 2 edge.
        is_edge = heat.region_map == heat.region_map.max()
        style.draw_borders(axes, (heat.region_map > 0).astype(np.uint8) + is_edge)
        letter = f"({'ab'[index]}) " if wide else ""
        axes.set_title(f"{letter}{heat.what}: {heat.source}")
        numbers = (("centre", heat.centre), ("edge", heat.edge), ("image", heat.whole))
        text = ", ".join(f"{name} {100 * value:.1f} %" for name, value in numbers)
        where = f"centre, edge: inner and outer region of {heat.partition}"
        axes.set_xlabel(f"{heat.measure}: {text}\n{where}, pixels pooled", fontsize=7)
    what = " or ".join(dict.fromkeys(heat.what for heat in heats))
    figure.colorbar(shown, ax=list(panels), shrink=0.8, pad=0.015, label=what)  # type: ignore[arg-type]
    return figure


@style.styled
def draw_regions(picture: NDArray[Any], region_map: NDArray[np.uint8], what: str = "") -> Figure:
    """The regions numbered from 1 over a picture (Fig. 4).

    Args:
        picture: (H, W) in 0..1 for a heat map, or (H, W, 3) uint8.
        region_map: (H, W) region of every pixel.
        what: the heat map shows, "" for an image.
    """
    height, width = region_map.shape
    is_map = picture.ndim == 2
    panel = style.COLUMN - (0.5 if is_map else 0.1)
    figure = style.new_figure(style.COLUMN, panel * height / width + 0.1)
    axes = figure.subplots()
    how = {"cmap": style.MAP_COLOURS, "vmin": 0, "vmax": 1} if is_map else {}
    shown = style.show_image(axes, picture, **how)
    style.draw_borders(axes, region_map)
    for index, place in enumerate(number_beside(region_map)):
        if place is not None:
            style.number(axes, place, str(index + 1))
    if is_map:
        figure.colorbar(shown, ax=axes, shrink=0.9, pad=0.02, label=what)  # type: ignore[arg-type]
    return figure


def number_beside(region_map: NDArray[np.uint8]) -> list[tuple[int, int] | None]:
    """(row, column) for the number of each region; None for an empty one.

    Rings are numbered on their right side: images are wider than high, and so are rings there.
    """
    places = number_places(region_map.astype(np.int64), int(region_map.max()) + 1)
    row, middle = region_map.shape[0] // 2, region_map.shape[1] // 2
    for region in range(len(places)):
        if is_around(region_map, region):
            columns = np.flatnonzero(region_map[row, middle:] == region)
            places[region] = (row, middle + round(float(columns.mean())))
    return places


def is_around(region_map: NDArray[np.uint8], region: int) -> bool:
    """Whether a region lies on both sides of the image's centre but not on it: an outer ring."""
    row, middle = region_map.shape[0] // 2, region_map.shape[1] // 2
    line = region_map[row] == region
    return bool(line[:middle].any() and line[middle:].any() and not line[middle])
