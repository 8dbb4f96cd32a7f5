"""Results by region of one or more methods: profiles with intervals, and heat maps of regions."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.bar import progress
from analysis.figures import style
from analysis.figures.inputs import FigureInput
from analysis.figures.maps import is_around
from analysis.uncertainty import Resampling, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts, check_same_means
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.scores import miou
from rgbt.tracking.pictures import colour_limits, number_places

LEAST, MOST_PIXELS, LONGEST = 16, 4096, 8
"""Largest side of ``size=`` in pixels, and largest ratio of the two sides."""

SPREAD = 0.3
"""Regions over which bars of several methods stand side by side."""

ABREAST = 3
"""Heat maps in one row."""

NUMBER_WIDTH = 0.3
"""Inches between two numbers in a heat map that stand side by side."""

Band = Literal["widest", "images", "seeds", "both"]
COVERS = {"images": "images", "seeds": "seeds", "both": "images and seeds"}
"""``band=`` -> what its interval is over."""


@dataclass(frozen=True)
class Profile:
    """MIoU by region of one method, percent.

    Attributes:
        means: (R,) mean over seeds.
        miou: of the whole image.
        bars: (2, R) ends of the intervals, or None where there are none.
        covers: what the interval is over: "images", "seeds", "images and seeds", or "".
        level: of the intervals; NaN without.
    """

    label: str
    partition: str
    means: NDArray[np.float64]
    miou: float
    seeds: int
    images: int
    bars: NDArray[np.float64] | None = None
    covers: str = ""
    level: float = math.nan


def make_heat(given: FigureInput) -> Figure:
    """Regions painted by their mIoU."""
    size = given.get("size", "480x640")
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", size)
    height, width = map(int, match.groups()) if match else (0, 0)
    if not (LEAST <= height <= MOST_PIXELS and LEAST <= width <= MOST_PIXELS):
        raise InputError(
            f"size must be HEIGHTxWIDTH with {LEAST} to {MOST_PIXELS} pixels each, such as 480x640,"
            f" got '{size}'."
        )
    if max(height, width) > LONGEST * min(height, width):
        raise InputError(f"size={size}: one side is more than {LONGEST} times the other.")
    runs = given.runs()
    absent = given.absent(counts for seeds in runs.values() for counts in seeds)
    methods = [means_only(label, seeds, absent) for label, seeds in runs.items()]
    return draw_heat(methods, (height, width))


def make_profile(given: FigureInput) -> Figure:
    """MIoU over the regions with bands."""
    methods, band = given.runs(), given.get("band", "widest")
    settings = Resampling(
        resamples=given.get("resamples", 10_000),
        level=given.get("level", 0.95),
        blocks=given.get("blocks", "auto"),
        absent=given.absent(counts for seeds in methods.values() for counts in seeds),
    )
    made = []
    with progress("resampling", len(methods)) as advance:
        for label, seeds in methods.items():
            made.append(profile(label, seeds, settings, band))  # type: ignore[arg-type]
            advance()
    return draw_profiles(made)


def profile(label: str, seeds: Sequence[Counts], settings: Resampling, band: Band) -> Profile:
    """MIoU by region with an interval.

    Args:
        label: of the method.
        seeds: counts of the same images, one file per seed.
        settings: see `analysis.uncertainty`.
        band: what the interval is over; "widest": both where there are several seeds, else images.

    Raises:
        InputError: an interval over seeds of a single seed, or counts that do not belong together.
    """
    if band in ("seeds", "both") and len(seeds) < 2:
        raise InputError(
            f"band={band} needs at least two seeds, but '{label}' has one; use band=images."
        )
    if band == "widest":
        band = "both" if len(seeds) > 1 else "images"
    metrics = [f"region/{region + 1}" for region in range(seeds[0].counts.shape[1])]
    found = estimate(seeds, [*metrics, "mIoU"], settings)
    field = {"images": "images", "seeds": "trainings", "both": "both"}[band]
    intervals = [getattr(found[name], field) for name in metrics]
    is_known = None not in intervals
    return Profile(
        label=label,
        partition=seeds[0].partition,
        means=np.array([found[name].value for name in metrics]),
        miou=float(found["mIoU"].value),
        seeds=len(seeds),
        images=len(seeds[0].names),
        bars=np.array([(each.low, each.high) for each in intervals]).T if is_known else None,
        covers=COVERS[band] if is_known else "",
        level=settings.level,
    )


def means_only(label: str, seeds: Sequence[Counts], absent: Absent) -> Profile:
    """MIoU by region without intervals, which a heat map does not show.

    Raises:
        InputError: seeds over other regions or with other scored classes.
    """
    for each in seeds:
        if each.partition != seeds[0].partition:
            raise InputError(
                f"runs: seeds of '{label}' were counted over {seeds[0].partition} and "
                f"{each.partition}; give counts with one partition."
            )
        check_same_means(seeds[0], each)
    by_region, scored = [each.by_region() for each in seeds], seeds[0].scored
    return Profile(
        label=label,
        partition=seeds[0].partition,
        means=100 * np.mean([miou(each, absent, scored) for each in by_region], axis=0),
        miou=float(100 * np.mean([miou(each.sum(0), absent, scored) for each in by_region])),
        seeds=len(seeds),
        images=len(seeds[0].names),
    )


def check_one_partition(profiles: Sequence[Profile]) -> None:
    """Raise InputError unless all profiles are over the same regions."""
    for each in profiles:
        if each.partition != profiles[0].partition:
            raise InputError(
                f"runs: '{profiles[0].label}' was counted over {profiles[0].partition} but "
                f"'{each.label}' over {each.partition}; give counts with one partition."
            )


@style.styled
def draw_profiles(profiles: Sequence[Profile]) -> Figure:
    """MIoU over the regions, one line per method, with the mIoU of the image in the legend.

    Intervals of one or two methods are bands; those of more are bars side by side, because bands
    would hide each other.
    """
    check_one_partition(profiles)
    figure = style.new_figure(style.COLUMN, 2.4 + 0.14 * len(profiles))
    axes = figure.subplots()
    regions = len(profiles[0].means)
    as_bars = len(profiles) > 2
    for index, each in enumerate(profiles):
        shift = SPREAD * (index / (len(profiles) - 1) - 0.5) if as_bars else 0.0
        places = np.arange(1, regions + 1) + shift
        how: dict[str, Any] = {
            **style.series_style(index),
            "label": f"{each.label} (mIoU {each.miou:.1f})",
        }
        if as_bars:
            lengths = None
            if each.bars is not None:
                lengths = np.maximum([each.means - each.bars[0], each.bars[1] - each.means], 0)
            axes.errorbar(places, each.means, lengths, elinewidth=0.7, **how)
            continue
        axes.plot(places, each.means, **how)
        if each.bars is not None:
            axes.fill_between(places, *each.bars, color=how["color"], alpha=0.15, linewidth=0.5)
    style.region_axis(axes, regions, f"region ({profiles[0].partition})")
    axes.set_ylabel("mIoU (%)")
    # For example "95 % intervals over images and seeds", and their numbers below.
    kinds = dict.fromkeys(each.covers or "nothing" for each in profiles)
    counted = (("seed", {each.seeds for each in profiles}), ("image", {p.images for p in profiles}))
    numbers = [
        f"{' or '.join(map(str, sorted(many)))} {word}{'' if many == {1} else 's'}"
        for word, many in counted
    ]
    title = f"{100 * profiles[0].level:g} % intervals over {' or '.join(kinds)}"
    axes.set_title(f"{title}\n{', '.join(numbers)}", fontsize=style.SMALL)
    style.series_legend(figure, axes, columns=1)
    return figure


@style.styled
def draw_heat(profiles: Sequence[Profile], image_hw: tuple[int, int]) -> Figure:
    """One (H, W) map per method with the mIoU of each region written into it, in one scale."""
    check_one_partition(profiles)
    limits = colour_limits([mean / 100 for each in profiles for mean in each.means.tolist()])
    region_map = map_of(profiles[0].partition, image_hw)
    height, width = image_hw
    columns = 2 if len(profiles) == 4 else min(ABREAST, len(profiles))
    rows = -(-len(profiles) // columns)
    size = style.COLUMN if columns == 1 else style.PAGE
    panel = (size - 0.6) / columns
    titles = [f"{style.folded(each.label, panel - 0.2)}\nmIoU {each.miou:.1f}" for each in profiles]
    lines = 1 + max(title.count("\n") for title in titles)
    figure = style.new_figure(size, rows * (panel * height / width + 0.06 + 0.14 * lines) + 0.05)
    panels = figure.subplots(rows, columns, squeeze=False).ravel()
    places = staircase(region_map, round(NUMBER_WIDTH * width / panel))
    for axes, each, title in zip(panels, profiles, titles, strict=False):
        how = {"cmap": style.MAP_COLOURS, "vmin": limits[0], "vmax": limits[1]}
        shown = style.show_image(axes, each.means[region_map], **how)
        style.draw_borders(axes, region_map)
        for place, value in zip(places, each.means, strict=True):
            if place is not None:
                style.number(axes, place, "-" if np.isnan(value) else f"{value:.1f}")
        axes.set_title(title)
    for axes in panels[len(profiles) :]:
        axes.set_axis_off()
    label = "mIoU of the region (%)"
    figure.colorbar(shown, ax=list(panels), shrink=0.85, pad=0.015, label=label)  # type: ignore[arg-type]
    return figure


def staircase(region_map: NDArray[np.uint8], step: int) -> list[tuple[int, int] | None]:
    """(row, column) for the value of each region; None for an empty one.

    Rings are too narrow for numbers one above the other: they go `step` pixels further to the left
    and to the right in turn, as far as their ring reaches.
    """
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
