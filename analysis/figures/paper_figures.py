"""The figures of the papers, each made from what was given on the command line.

Everything heavy is imported when a figure is made, so that the list of figures is there at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from analysis.figures.figure_spec import (
    DATASET_AND_METRIC,
    OF_RUNS,
    RUNS,
    SPATIAL,
    STATISTICS,
    figure,
)
from analysis.figures.inputs import FigureInput, check_one_dataset
from analysis.figures.qualitative import qualitative
from rgbt.checks import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PARTS = ("all", "day", "night")
STRIPS_AND_RINGS = ("vertical", "horizontal", "ring")


@figure(
    "spatialseg/fig1",
    "pixel-level IoU and sample occupancy, with centre, edge and mean",
    f"maps= (of analysis.score) for (a); {STATISTICS} for (b)",
    keys=("maps", "part", *SPATIAL),
    groups=DATASET_AND_METRIC,
    idle=(),
)
def spatialseg_fig1(given: FigureInput) -> Figure:
    """Heat maps of IoU and of sample occupancy."""
    from analysis.figures import maps

    heats = []
    has_statistics = "statistics" in given.values or given.has_dataset
    if "maps" not in given.values and not has_statistics:
        raise InputError(
            f"figure={given.figure} needs maps=... (folder of rgbt score) for the "
            "IoU, statistics=... (of rgbt spatial) or dataset=... for the sample "
            "occupancy, or both."
        )
    if not has_statistics:
        given.refuse(["part"], "statistics=... or dataset=..., whose images it chooses")
    part = given.get("part", PARTS[0])
    if "maps" in given.values:
        pixel_maps = given.maps()
        if not has_statistics:
            given.check_split(pixel_maps.split, given.values["maps"])
        heats.append(maps.iou_heat(pixel_maps, given.regions, beside_part=part != "all"))
    else:
        given.refuse(["metric.absent"], "maps=...")
    if has_statistics:
        heats.append(maps.occupancy_heat(given.statistics(), given.regions, part))
    return maps.draw_heats(heats)


@figure(
    "spatialseg/fig2",
    "IoU, accuracy and occupancy over vertical, horizontal and ring regions",
    f"methods=label:folder (of analysis.score); {STATISTICS}",
    keys=("methods", "regions", "absent", *SPATIAL),
    groups=("dataset",),
)
def spatialseg_fig2(given: FigureInput) -> Figure:
    """IoU, accuracy and occupancy over three partitions."""
    from analysis.figures import trends
    from analysis.figures.maps import occupancy_over
    from rgbt.metrics.metric import Regions

    regions = given.get("regions", 5)
    counts = {each: given.counts("methods", f"{each}{regions}") for each in STRIPS_AND_RINGS}
    absent = given.absent(each for methods in counts.values() for each in methods.values())
    statistics = given.statistics()
    hw = statistics.region_map.shape
    of_methods = next(iter(counts["ring"].values()))
    check_one_dataset(statistics, of_methods)
    series = []
    for partition, methods in counts.items():
        aspect = "image" if partition == "ring" else None
        chosen: Any = {"partition": partition, "aspect": aspect, "absent": absent}
        region_map = Regions(regions=regions, **chosen).map((hw[0], hw[1]))
        occupancy = occupancy_over(statistics, region_map)
        series.append(trends.trend(partition, occupancy, methods, chosen["absent"]))
    return trends.draw(series, splits=(statistics.split, of_methods.split))


@figure(
    "spatialseg/fig3",
    "occupancy of each class by region, and the mIoU of a method",
    f"{STATISTICS}; methods=label:folder for the mIoU",
    keys=("methods", "part", "absent", *SPATIAL),
    groups=DATASET_AND_METRIC,
    metric="ring9",
)
def spatialseg_fig3(given: FigureInput) -> Figure:
    """Occupancy of each class, and mIoU, by region."""
    from analysis.figures import classes

    statistics = given.statistics(by_region=True)
    method = None
    if "methods" not in given.values:
        given.refuse(["absent"], "methods=...")
    else:
        methods = given.counts("methods", statistics.partition)
        if len(methods) != 1:
            raise InputError(f"methods: {given.figure} shows one method, got {len(methods)}.")
        method = next(iter(methods.items()))
        check_one_dataset(statistics, method[1])
    absent = given.absent([method[1]]) if method else "released"
    made = classes.class_regions(statistics, given.get("part", PARTS[0]), method, absent)
    return classes.draw(made, splits=(statistics.split, method[1].split if method else ""))


@figure(
    "spatialseg/fig4",
    "the regions, numbered, over a heat map or an image; any partition with metric=",
    "maps=, statistics= or dataset= (with names=)",
    keys=("maps", "names", *SPATIAL),
    groups=DATASET_AND_METRIC,
    metric="ring9",
)
def spatialseg_fig4(given: FigureInput) -> Figure:
    """A partition over a heat map or an image."""
    from analysis.figures import maps
    from analysis.predictions.maps import iou_map
    from analysis.statistics.derive import occupancy_map

    sources = [key for key in ("maps", "statistics") if key in given.values]
    if len(sources) + given.has_dataset != 1:
        raise InputError(
            f"figure={given.figure} needs one picture: maps=... (folder of rgbt score), "
            "statistics=... (of rgbt spatial), or dataset=... for its first image or that of "
            "names=..."
        )
    if not given.has_dataset:
        given.refuse(["names"], "dataset=...")
    picture: Any
    what = ""
    if given.has_dataset:
        picture = given.dataset.read(_one_name(given)).rgb
    elif sources == ["maps"]:
        pixel_maps = given.maps()
        given.check_split(pixel_maps.split, given.values["maps"])
        picture, what = iou_map(pixel_maps), f"IoU ({pixel_maps.name}, {pixel_maps.split})"
    else:
        statistics = given.statistics()
        picture, what = occupancy_map(statistics), f"sample occupancy ({statistics.split})"
    region_map = given.regions.map((picture.shape[0], picture.shape[1]))
    return maps.draw_regions(maps.RegionPicture(picture, region_map, given.regions.name, what))


@figure(
    "spatialseg/fig5",
    "Laplacian variance by region: RGB and thermal, all, day, night",
    STATISTICS,
    keys=SPATIAL,
    groups=DATASET_AND_METRIC,
    metric="ring9",
)
def spatialseg_fig5(given: FigureInput) -> Figure:
    """Laplacian variance by region."""
    from analysis.figures import image_quality
    from analysis.statistics.resampling import ConsecutiveBlocks

    statistics = given.statistics(by_region=True)
    return image_quality.draw(
        image_quality.laplacian_series(statistics, ConsecutiveBlocks(statistics))
    )


@figure(
    "spatialseg/fig6",
    "signal-to-noise ratio by region: RGB and thermal, all, day, night",
    STATISTICS,
    keys=("estimator", "average", *SPATIAL),
    groups=DATASET_AND_METRIC,
    metric="ring9",
)
def spatialseg_fig6(given: FigureInput) -> Figure:
    """Signal-to-noise ratio by region."""
    from analysis.figures import image_quality
    from analysis.statistics.derive import AVERAGES
    from analysis.statistics.measure import ESTIMATORS
    from analysis.statistics.resampling import ConsecutiveBlocks

    estimator, average = given.get("estimator", ESTIMATORS[0]), given.get("average", AVERAGES[0])
    statistics = given.statistics(by_region=True)
    series = image_quality.snr_series(statistics, ConsecutiveBlocks(statistics), estimator, average)
    return image_quality.draw(series)


spatialseg_fig8 = qualitative("spatialseg/fig8", "qualitative results")
spatialseg_fig9 = qualitative("spatialseg/fig9", "qualitative results on another data set")


@figure(
    "temporal/fig5",
    "TC and CA of variants by class",
    f"{RUNS}, with counts of pairs of frames (rgbt consistency)",
    keys=("frames", *OF_RUNS),
)
def temporal_fig5(given: FigureInput) -> Figure:
    """TC and CA by class."""
    from analysis.figures import consistency

    frames: Any = given.get("frames", "aligned")
    runs = given.runs(frames)
    absent = given.absent(counts for seeds in runs.values() for counts in seeds)
    return consistency.draw(consistency.class_consistency(runs, absent))


temporal_fig6 = qualitative(
    "temporal/fig6", "qualitative results, one column per image with layout=columns"
)
crm_fig4 = qualitative("crm/fig4", "qualitative results")


@figure(
    "crm/fig5",
    "masks: a square, and patches of 8, 16, 32 and 64 pixels, on a pair of images",
    "dataset=",
    keys=("names", "split", "patches", "seed"),
    groups=("dataset",),
)
def crm_fig5(given: FigureInput) -> Figure:
    """Masks on a pair of images."""
    from analysis.figures import masks
    from rgbt.config.command import built

    patches = given.get("patches", masks.PATCHES)
    sample = given.dataset.read(_one_name(given))
    chosen = masks.masker_overrides(patches).items()
    maskers = {title: built("masker", overrides) for title, overrides in chosen}
    multiple = masks.whole_cells(patches)
    return masks.draw(masks.mask_examples(sample, maskers, multiple, given.get("seed", 0)))


@figure(
    "multihead/fig3",
    "gradients of entropy minimisation and maximum squares loss",
    "nothing: analytic",
)
def multihead_fig3(given: FigureInput) -> Figure:
    """Gradients of two losses."""
    from analysis.figures import gradients

    del given  # analytic: made from nothing
    return gradients.draw(gradients.gradient_curves())


def _one_name(given: FigureInput) -> str:
    names = given.names(1)
    if len(names) > 1:
        raise InputError(f"names: figure={given.figure} shows one image, got {len(names)}.")
    return names[0]
