"""SpatialSeg, Figs. 1 to 6: scores and statistics of images over pixel positions and regions.

The paper does not state how large its "centre" and its "edge" are, nor how the numbers of Fig. 1
come from its maps. Here centre and edge are the innermost and the outermost ring of the partition,
which the figure names and which can be changed with ``metric=``; and the numbers are those of the
tables: the regional mIoU, and the sample occupancy rate, both from the pixels of a ring added up
over all images before anything is divided. They are not means over the pixels of the map.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from analysis.figures import inputs, plots
from analysis.figures.inputs import Config, Drawn, StatisticsOptions, figure
from analysis.predictions.maps import PixelMaps
from analysis.statistics.collect import ALL, MODALITIES, SpatialStatistics
from analysis.statistics.resampled import (
    ResampledSplit,
    Values,
    check_background,
    normalised,
    occupancy_map,
    occupancy_of,
)
from analysis.uncertainty import Resampling
from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.metrics.counts import Counts, convention
from rgbt.metrics.metric import Absent, Regions
from rgbt.metrics.names import NIGHT
from rgbt.metrics.scores import class_mean, miou, recall, tally

TRENDS = {
    "vertical": "(a) vertical (left to right)",
    "horizontal": "(b) horizontal (top to bottom)",
    "ring": "(c) rings (inside to outside)",
}
NAMES = {"rgb": "RGB", "thermal": "thermal"}
# Marker and line of each part; the modality is the colour.
MARKS = {"all": ("o", "-"), "day": ("s", "--"), "night": ("^", ":")}

# Regions over which six series are drawn side by side, so that their bars do not overlap.
SPREAD = 0.5

# A logarithmic axis where one modality's median is more than this many times the other's.
FAR_APART = 5.0

# Numbers below a map of Fig. 1, fields of `Heat`.
NUMBERS = ("centre", "edge", "image")

# Resamples for the bars of Figs. 5 and 6.
RESAMPLING = Resampling(resamples=2000)


Maps = Annotated[str, Help("output of rgbt score: folder or maps.npz")]


def open_maps(maps: str, split: str) -> PixelMaps:
    """Load pixel maps; InputError: of another split."""
    found = PixelMaps.load(inputs.file_in(maps, "maps.npz"))
    inputs.check_split(split, found.split, maps)
    return found


class Heat(NamedTuple):
    """A value at every pixel position, 0..1, and the three numbers of Fig. 1, percent.

    `source` is a method or a data set, its split, and which images of it; `measure` what the
    numbers are; `values` and `region_map` are (H, W), NaN where there is nothing to score.
    """

    what: str
    source: str
    measure: str
    values: Values
    region_map: NDArray[np.uint8]
    centre: float
    edge: float
    image: float


def iou_heat(maps: PixelMaps, regions: Regions, images: str = "") -> Heat:
    """Compute pixel-level IoU, mean over classes (Fig. 1a), and its numbers over rings.

    `images`: which images, where it matters.

    The map excludes classes that never occur at a pixel; in a ring they count as `regions` says.
    """
    region_map = ring_map(regions, maps.intersection.shape[1:])

    def pooled(chosen: NDArray[np.bool_]) -> float:
        right = maps.intersection[:, chosen].sum(1, dtype=np.int64)
        either = maps.union[:, chosen].sum(1, dtype=np.int64)
        nothing = 0.0 if regions.absent == "released" else np.nan
        ious = np.where(either > 0, right / np.maximum(either, 1), nothing)
        return float(100 * class_mean(ious, maps.scored))

    masks = region_map == 0, region_map == regions.regions - 1, np.ones_like(region_map, bool)
    source = ", ".join(filter(None, [maps.name, maps.split, images]))
    return Heat("IoU", source, "mIoU", maps.iou(), region_map, *map(pooled, masks))


def occupancy_heat(stats: SpatialStatistics, regions: Regions, part: str = ALL) -> Heat:
    """Compute the sample occupancy rate of a part (Fig. 1b; Eq. 1), and over rings (Eq. 2)."""
    values = occupancy_map(stats, part)
    region_map = ring_map(regions, values.shape)
    by_region = 100 * occupancy_over(stats, region_map, part)
    (whole,) = 100 * occupancy_over(stats, np.zeros_like(region_map), part)
    source = ", ".join([stats.dataset, stats.split, *([] if part == ALL else [part])])
    numbers = float(by_region[0]), float(by_region[-1]), float(whole)
    return Heat("sample occupancy", source, "SOR", values, region_map, *numbers)


def occupancy_over(
    stats: SpatialStatistics, region_map: NDArray[np.uint8], part: str = ALL
) -> Values:
    """Compute the sample occupancy rate (R,) (Eq. 2), also of regions that were not measured."""
    check_background(stats)
    index = region_map.ravel()
    pixels = [np.bincount(index, of_class.ravel()) for of_class in stats.occupied_in(part)]
    return occupancy_of(np.stack(pixels, axis=1), stats.is_background)


def ring_map(regions: Regions, image_hw: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return the map of a partition that has a centre; InputError where it has none."""
    if regions.partition != "ring":
        raise InputError(f"metric: {regions.name} has no centre and no edge; use rings.")
    return regions.map((image_hw[0], image_hw[1]))


@figure(
    "spatialseg/fig1",
    "pixel-level IoU and sample occupancy, with centre, edge and mean",
    "dataset",
    "metric",
)
@plots.styled
def heats(
    config: Config, given: StatisticsOptions, *, maps: Maps = "", part: inputs.Part = "all"
) -> Drawn:
    """Draw one panel per map with its three numbers, and one scale from 0 to 1 for all."""
    shown, has_statistics = [], bool(given.statistics) or config.chooses("dataset")
    if not has_statistics and (part != ALL or not maps):
        raise InputError(f"statistics: needed for part={part} or without maps=...")
    if maps:
        opened = open_maps(maps, "" if has_statistics else given.split)
        shown.append(iou_heat(opened, config.regions, "all images" if part != ALL else ""))
    if has_statistics:
        shown.append(occupancy_heat(given.open(config), config.regions, part))
    height, width = shown[0].values.shape
    page = plots.PAGE if len(shown) > 1 else plots.COLUMN
    panel = (page - (0.8 if len(shown) > 1 else 0.6)) / len(shown)
    made = plots.new_figure(page, panel * height / width + 0.62)
    panels = made.subplots(1, len(shown), squeeze=False)[0]
    where = f"centre, edge: inner and outer region of {config.regions.name}, pixels pooled"
    for letter, axes, panel_map in zip("ab", panels, shown, strict=False):
        # The borders of centre and edge alone: 0 centre, 1 between, 2 edge.
        is_edge = panel_map.region_map == panel_map.region_map.max()
        borders = (panel_map.region_map > 0).astype(np.uint8) + is_edge
        image: Any = plots.heat(axes, panel_map.values, borders, vmin=0, vmax=1)
        title = f"{panel_map.what}: {panel_map.source}"
        axes.set_title(f"({letter}) {title}" if len(shown) > 1 else title)
        numbers = ", ".join(f"{name} {getattr(panel_map, name):.1f} %" for name in NUMBERS)
        axes.set_xlabel(f"{panel_map.measure}: {numbers}\n{where}", fontsize=plots.SMALL)
    label = " or ".join(panel_map.what for panel_map in shown)
    made.colorbar(image, ax=[*panels], shrink=0.8, pad=0.015, label=label)
    return made, pd.DataFrame(shown)[["what", "source", "measure", *NUMBERS]]


@figure("spatialseg/fig2", "IoU, accuracy and occupancy over strips and rings", "dataset")
def trends(
    config: Config,
    given: StatisticsOptions,
    *,
    methods: inputs.Methods,
    regions: Annotated[inputs.Count, Help("number of regions of each partition")] = 5,
    absent: inputs.AbsentClasses = None,
) -> Drawn:
    """Draw how the scores change over three partitions."""
    counts, every = {}, list[Counts]()
    for partition in TRENDS:
        counts[partition] = inputs.open_scored(methods, f"{partition}{regions}")
        every += counts[partition].values()
    convened = absent or convention(every)
    stats, first = given.open(config), next(iter(counts["ring"].values()))
    inputs.check_one_dataset(stats, first)
    frames, (height, width) = [], stats.region_map.shape
    for partition, scored in counts.items():
        chosen: Any = {"partition": partition, "aspect": "image" if partition == "ring" else None}
        cut = Regions(regions=regions, absent=convened, **chosen).map((height, width))
        frames.append(trend(partition, occupancy_over(stats, cut), scored, convened))
    frame = pd.concat(frames, ignore_index=True)
    return draw_trends(frame, (stats.split, first.split)), frame


def trend(
    partition: str, occupancy: Values, methods: Mapping[str, Counts], absent: Absent
) -> pd.DataFrame:
    """Compute IoU and accuracy of methods, and the sample occupancy, by region of a partition.

    IoU and accuracy of a region are means over the scored classes, of the pixels of all images.
    Whether the paper counts the background is not stated; here it counts, as in its tables.
    Scores are in percent; value is less that of region 1, as the figure shows it.
    """
    series = {("SOR", "SOR"): occupancy}
    for label, counts in methods.items():
        check_partition(label, counts, f"{partition}{len(occupancy)}")
        summed = tally(counts.by_region())
        series["IoU", f"IoU ({label})"] = miou(summed, absent, counts.scored)
        series["Acc", f"Acc ({label})"] = class_mean(recall(summed, absent), counts.scored)
    rows = []
    for kind in ("IoU", "Acc", "SOR"):
        for name, scores in series.items():
            if name[0] != kind:
                continue
            for region, score in enumerate(100 * scores, 1):
                rows.append((partition, *name, region, score, score - 100 * scores[0]))
    columns = ["partition", "kind", "series", "x", "score", "value"]
    return pd.DataFrame(rows, columns=columns).assign(low=math.nan, high=math.nan)


def check_partition(label: str, counts: Counts, partition: str) -> None:
    """Refuse counts over other regions."""
    if counts.partition not in (partition, f"{partition}_released_3_4"):
        raise InputError(
            f"methods: '{label}' was counted over {counts.partition}, expected {partition}."
        )


@plots.styled
def draw_trends(frame: pd.DataFrame, splits: tuple[str, str]) -> Figure:
    """Draw a panel per partition; methods by colour, IoU in full and accuracy in open markers."""
    made = plots.new_figure(plots.PAGE, 2.5)
    panels = made.subplots(1, len(TRENDS), sharey=True, squeeze=False)[0]
    styles = {"SOR": {"color": plots.APART, "linestyle": ":", "marker": "*", "ms": 5}}
    for kind, line in (("IoU", "-"), ("Acc", "--")):
        for index, name in enumerate(frame[frame["kind"] == kind]["series"].unique()):
            how = plots.series_style(index)
            face = how["color"] if kind == "IoU" else "white"
            styles[name] = {**how, "linestyle": line, "markerfacecolor": face}
    for axes, (partition, title) in zip(panels, TRENDS.items(), strict=True):
        axes.set_title(title)
        axes.axhline(0, color="grey", linewidth=0.6)
        plots.line_plot(axes, frame[frame["partition"] == partition], styles)
        plots.region_axis(axes, frame["x"].max())
    panels[0].set_ylabel("change from region 1\n(percent points)")
    plots.series_legend(made, panels[0], columns=5)
    note_splits(made, *splits)
    return made


def note_splits(made: Figure, occupancy: str, scores: str) -> None:
    """Write above the figure that occupancy and scores are of different splits, if they are."""
    if scores not in ("", occupancy):
        made.suptitle(f"SOR: split {occupancy}; scores: split {scores}", fontsize=plots.SMALL)


@figure(
    "spatialseg/fig3",
    "occupancy of each class by region, and the mIoU of a method",
    "dataset",
    "metric",
    metric="ring9",
)
def classes(
    config: Config,
    given: StatisticsOptions,
    *,
    methods: inputs.Methods = "",
    part: inputs.Part = "all",
    absent: inputs.AbsentClasses = None,
) -> Drawn:
    """Draw where the samples of each class lie, beside the mIoU of each region."""
    stats, method = given.open(config, by_region=True), None
    if methods:
        method, *others = inputs.open_scored(methods, stats.partition).items()
        if others:
            raise InputError("methods: the figure shows one method.")
        inputs.check_one_dataset(stats, method[1])
    frame = class_regions(stats, part, method, absent)
    images = "" if part == ALL else f"; images of the {part}"
    made = draw_classes(frame, f"region ({stats.partition}){images}")
    note_splits(made, stats.split, method[1].split if method else "")
    return made, frame


def class_regions(
    stats: SpatialStatistics,
    part: str = ALL,
    method: tuple[str, Counts] | None = None,
    absent: Absent | None = None,
) -> pd.DataFrame:
    """Compute the series of Fig. 3: share_kr = 100 SOR_kr / max_r SOR_kr, and the mIoU of a method.

    The mIoU is over all scored classes with the background, which the paper does not state. NaN: a
    class that occurs nowhere. InputError: counts over other regions, or a part without images.
    """
    shares = 100 * normalised(ResampledSplit(stats).classes(part)[0])
    series = {stats.classes[index]: shares[index] for index in stats.objects}
    if method is not None:
        label, counts = method
        check_partition(label, counts, stats.partition)
        if part != ALL:
            at_night = zip(counts.names, counts.night or (), strict=False)
            counts = counts.select(name for name, dark in at_night if dark == (part == NIGHT))
            if not counts.names:
                raise InputError(f"part={part}: the counts of '{label}' contain no such image.")
        scores = miou(tally(counts.by_region()), absent or counts.absent, counts.scored)
        series[f"mIoU ({label})"] = 100 * scores
    rows = []
    for name, values in series.items():
        rows += [(name, region, number) for region, number in enumerate(values, 1)]
    return pd.DataFrame(rows, columns=["series", "x", "value"]).assign(low=math.nan, high=math.nan)


@plots.styled
def draw_classes(frame: pd.DataFrame, regions: str) -> Figure:
    """Draw a line per class, and the mIoU as a thick black line, all in percent on one axis."""
    made = plots.new_figure(plots.PAGE, 2.8)
    axes, more, styles = made.subplots(), "", dict[str, dict[str, Any]]()
    for name, rows in frame.groupby("series"):
        missing = " (none)" if rows["value"].isna().all() else ""
        styles[str(name)] = {"label": plots.readable(str(name)) + missing}
        if str(name).startswith("mIoU ("):
            look = {"color": plots.APART, "marker": "*", "linestyle": "-"}
            styles[str(name)], more = {**look, "linewidth": 2.2, "markersize": 7}, "; mIoU (%)"
    plots.line_plot(axes, frame, styles)
    plots.region_axis(axes, frame["x"].max(), regions)
    axes.set(ylim=(0, 105), ylabel=f"SOR, percent of the class's\nlargest region{more}")
    made.legend(*axes.get_legend_handles_labels(), loc="outside right center")
    return made


@figure(
    "spatialseg/fig4",
    "the regions, numbered, over a heat map or an image",
    "dataset",
    "metric",
    metric="ring9",
)
@plots.styled
def regions(
    config: Config, given: StatisticsOptions, *, maps: Maps = "", names: inputs.Names = ""
) -> Drawn:
    """Draw the regions numbered from 1 over a picture."""
    if bool(maps) == config.chooses("dataset"):
        raise InputError("maps: give one of maps=... and dataset=...")
    picture: NDArray[Any]
    what, how = "", {"vmin": 0, "vmax": 1}
    if maps:
        opened = open_maps(maps, given.split)
        picture, what = opened.iou(), f"IoU ({opened.name}, {opened.split})"
    else:
        picture = config.dataset.read(config.names(names, given.split)[0]).rgb
    region_map = config.regions.map((picture.shape[0], picture.shape[1]))
    panel = plots.COLUMN - (0.5 if what else 0.1)
    height, width = region_map.shape
    made = plots.new_figure(plots.COLUMN, panel * height / width + 0.1)
    axes = made.subplots()
    numbers = [str(region + 1) for region in range(region_map.max() + 1)]
    shown: Any = plots.heat(axes, picture, region_map, numbers, panel, **(how if what else {}))
    if what:
        made.colorbar(shown, ax=axes, shrink=0.9, pad=0.02, label=what)
    pixels = np.bincount(region_map.ravel())
    return made, pd.DataFrame({"region": numbers, "pixels": pixels})


@figure(
    "spatialseg/fig5",
    "Laplacian variance by region: RGB and thermal, all, day, night",
    "dataset",
    "metric",
    metric="ring9",
)
def laplacian(config: Config, given: StatisticsOptions) -> Drawn:
    """Draw the Laplacian variance by region (Eq. 3), mean over images."""
    sample = ResampledSplit(given.open(config, by_region=True), RESAMPLING)
    frame = by_region(sample, "laplacian")
    return draw_by_region(frame, sample, "Laplacian variance\n(squared grey levels)"), frame


@figure(
    "spatialseg/fig6",
    "signal-to-noise ratio by region: RGB and thermal, all, day, night",
    "dataset",
    "metric",
    metric="ring9",
)
def snr(
    config: Config,
    given: StatisticsOptions,
    *,
    estimator: Annotated[
        Literal["immerkaer", "wavelet_mad", "std"],
        Help("estimator of the noise: immerkaer, wavelet_mad or std"),
    ] = "immerkaer",
    average: Annotated[
        Literal["pooled", "images"], Help("signal-to-noise ratio over images: pooled or images")
    ] = "pooled",
) -> Drawn:
    """Draw the signal-to-noise ratio by region (Eq. 4)."""
    sample = ResampledSplit(given.open(config, by_region=True), RESAMPLING, (estimator, average))
    frame = by_region(sample, "snr")
    return draw_by_region(frame, sample, f"signal-to-noise ratio ({estimator})"), frame


def by_region(sample: ResampledSplit, quantity: str) -> pd.DataFrame:
    """Compute a quantity by region, with 95 % intervals over blocks of images (NaN: too few)."""
    rows = []
    for index, modality in enumerate(MODALITIES):
        for part in sample.stats.subsets():
            images = int(sample.stats.chosen(part).sum())
            values = getattr(sample, quantity)(part)[:, index]
            for region, of_region in enumerate(values.T, 1):
                about = f"{NAMES[modality]}, {part}", modality, part, images, region
                rows.append((*about, *sample.bounded(of_region, part)))
    names = ["series", "modality", "part", "images", "x", "value", "low", "high"]
    return pd.DataFrame(rows, columns=names)


@plots.styled
def draw_by_region(frame: pd.DataFrame, sample: ResampledSplit, measure: str) -> Figure:
    """Draw six lines with intervals: modality by colour, part by marker and line."""
    made = plots.new_figure(plots.COLUMN, 3.1)
    axes, styles = made.subplots(), {}
    for name, modality, part in frame[["series", "modality", "part"]].drop_duplicates().to_numpy():
        colour, (marker, line) = plots.COLOURS[MODALITIES.index(modality)], MARKS[part]
        look: dict[str, Any] = {"color": colour, "marker": marker, "linestyle": line}
        face = colour if part == ALL else "white"
        styles[name] = {**look, "markerfacecolor": face, "elinewidth": 0.6}
    plots.line_plot(axes, frame, styles, bars=True, spread=SPREAD)
    plots.region_axis(axes, frame["x"].max(), f"region ({sample.stats.partition})")
    middles = frame[frame["part"] == ALL].groupby("modality")["value"].median()
    if 0 < FAR_APART * middles.min() < middles.max():
        axes.set_yscale("log")
        axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
        axes.yaxis.set_minor_formatter(NullFormatter())
    else:
        axes.set_ylim(bottom=0)
    axes.set_ylabel(measure)
    numbers = frame.drop_duplicates("part")[["part", "images"]].astype(str).agg(" ".join, axis=1)
    text = f"bars: 95 % over {sample.blocks.said}\n({', '.join(numbers)} images)"
    axes.set_title(plots.folded(text, plots.COLUMN), fontsize=plots.SMALL)
    made.legend(*axes.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return made
