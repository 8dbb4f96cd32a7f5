"""Results by region of one or more methods: profiles with intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import (
    COLUMN,
    SMALL,
    new_figure,
    region_axis,
    series_legend,
    series_style,
    styled,
)
from analysis.uncertainty import Estimate, Interval, Resampling, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts, check_same_means
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import miou

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SPREAD = 0.3
"""Regions over which bars of several methods stand side by side."""


@dataclass(frozen=True)
class Profile:
    """MIoU by region of one method, percent.

    Attributes:
        means: (R,) mean over seeds.
        miou: of the whole image.
        low: (R,) lower ends of the intervals, or None where there are none.
        high: (R,) upper ends.
        covers: what the interval is over: "images", "seeds", "images and seeds", or "".
        level: of the intervals; NaN without.
    """

    label: str
    partition: str
    means: NDArray[np.float64]
    miou: float
    seeds: int
    images: int
    low: NDArray[np.float64] | None = None
    high: NDArray[np.float64] | None = None
    covers: str = ""
    level: float = math.nan


Band = Literal["widest", "images", "seeds", "both"]
BANDS: tuple[Band, ...] = get_args(Band)

COVERS = {"images": "images", "seeds": "seeds", "both": "images and seeds"}
"""``band=`` -> what its interval is over."""


def profile(label: str, seeds: Sequence[Counts], settings: Resampling, band: Band) -> Profile:
    """MIoU by region with an interval.

    Args:
        label: what the method is called.
        seeds: counts of the same images, one file per seed.
        settings: of the resampling, see `analysis.uncertainty`.
        band: what the interval is over: "images", "seeds", "both", or "widest": both where there
            are several seeds, else images.

    Raises:
        InputError: an interval over seeds of a single seed, or counts that do not belong together.
    """
    if band in ("seeds", "both") and len(seeds) < 2:
        raise InputError(
            f"band={band} needs at least two seeds, but '{label}' has one; use band=images."
        )
    if band == "widest":
        band = "both" if len(seeds) > 1 else "images"
    regions = seeds[0].counts.shape[1]
    metrics = [*(f"region/{region + 1}" for region in range(regions)), "mIoU"]
    found = estimate(seeds, metrics, settings)
    intervals = [_interval(found[name], band) for name in metrics[:-1]]
    known = [interval for interval in intervals if interval is not None]
    low, high = np.array([(each.low, each.high) for each in known]).reshape(-1, 2).T
    return Profile(
        label=label,
        partition=seeds[0].partition,
        means=np.array([found[name].value for name in metrics[:-1]]),
        miou=float(found["mIoU"].value),
        low=low if len(known) == regions else None,
        high=high if len(known) == regions else None,
        covers=COVERS[band] if len(known) == regions else "",
        seeds=len(seeds),
        images=len(seeds[0].names),
        level=settings.level,
    )


def means_only(label: str, seeds: Sequence[Counts], absent: Absent) -> Profile:
    """MIoU by region without intervals, which a heat map does not show.

    Args:
        label: what the method is called.
        seeds: counts, one file per seed.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.

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


def _interval(found: Estimate, band: Band) -> Interval | None:
    return {"images": found.images, "seeds": found.trainings, "both": found.both}[band]


def check_one_partition(profiles: Sequence[Profile]) -> None:
    """Raise InputError unless all profiles are over the same regions."""
    for each in profiles:
        if each.partition != profiles[0].partition:
            raise InputError(
                f"runs: '{profiles[0].label}' was counted over {profiles[0].partition} but "
                f"'{each.label}' over {each.partition}; give counts with one partition."
            )


@styled
def draw_profiles(profiles: Sequence[Profile]) -> Figure:
    """MIoU over the regions, one line per method, with the mIoU of the image in the legend.

    Intervals of one or two methods are bands; those of more are bars side by side, because bands
    would hide each other.
    """
    check_one_partition(profiles)
    figure = new_figure(COLUMN, 2.4 + 0.14 * len(profiles))
    axes = figure.subplots()
    regions = len(profiles[0].means)
    as_bars = len(profiles) > 2
    for index, each in enumerate(profiles):
        shift = SPREAD * (index / (len(profiles) - 1) - 0.5) if as_bars else 0.0
        places = np.arange(1, regions + 1) + shift
        style = series_style(index)
        label = f"{each.label} (mIoU {each.miou:.1f})"
        if as_bars:
            lengths = None
            if each.low is not None and each.high is not None:
                lengths = np.maximum([each.means - each.low, each.high - each.means], 0)
            axes.errorbar(places, each.means, lengths, label=label, elinewidth=0.7, **style)
            continue
        axes.plot(places, each.means, label=label, **style)
        if each.low is not None and each.high is not None:
            colour = style["color"]
            axes.fill_between(places, each.low, each.high, color=colour, alpha=0.15, linewidth=0.5)
    region_axis(axes, regions, f"region ({profiles[0].partition})")
    axes.set_ylabel("mIoU (%)")
    axes.set_title(band_text(profiles), fontsize=SMALL)
    series_legend(figure, axes, columns=1)
    return figure


def band_text(profiles: Sequence[Profile]) -> str:
    """What is drawn around the lines: "95 % intervals over images and seeds", and their numbers."""
    kinds = list(dict.fromkeys(each.covers or "nothing" for each in profiles))
    seeds = sorted({each.seeds for each in profiles})
    images = sorted({each.images for each in profiles})
    number_of = [
        f"{' or '.join(map(str, many))} {word}{'' if many == [1] else 's'}"
        for many, word in ((seeds, "seed"), (images, "image"))
    ]
    level = f"{100 * profiles[0].level:g} %"
    return f"{level} intervals over {' or '.join(kinds)}\n{', '.join(number_of)}"
