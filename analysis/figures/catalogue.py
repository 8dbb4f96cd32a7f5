"""All figures by name: content, inputs, and the function that makes the figure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, Any

from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError, check_choice, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STATISTICS = "statistics= (of rgbt spatial) or dataset="
SPATIAL = ("statistics", "split")
DATASET_AND_METRIC = ("dataset", "metric")
PANELS = "dataset=, methods=label:folder of predictions"
PAIRS = "dataset=, pairs= (of rgbt consistency export=), methods=label:folder of predictions"
PANEL_KEYS = (
    *("methods", "names", "pick", "rows", "split", "layout", "format", "palette", "prefix"),
    "suffix",
)
RUNS = "runs= (run, group or counts, with labels: label:run)"
OF_RUNS = ("runs", "runs_dir", "split", "absent")
FAILING = "runs= (run, group or folder of rgbt robustness, with labels: label:run)"


@dataclass(frozen=True)
class FigureSpec:
    """One figure.

    Attributes:
        maker: module of this package and its function from a `FigureInput` to a figure; imported
            when the figure is made, so that the list of figures is there at once.
        needs: required inputs, in words.
        keys: keys that take effect, beside ``figure`` and ``out``.
        groups: groups of the configuration that take effect.
        metric: the partition unless ``metric=`` is given.
        idle: keys of the configuration below `groups` that have no effect.
        numbers: as `maker`, to what the figure shows as text by the ending of its file; "": none.
    """

    maker: str
    shows: str
    needs: str
    keys: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    metric: str = "ring5"
    idle: tuple[str, ...] = ("metric.absent",)
    numbers: str = ""


def _panel(shows: str) -> FigureSpec:
    return FigureSpec("panels.make", shows, PANELS, PANEL_KEYS, DATASET_AND_METRIC)


def _pairs(shows: str) -> FigureSpec:
    keys = (
        *("pairs", "methods", "view_set", "names", "pick", "rows", "layout", "format"),
        "palette",
    )
    groups = ("dataset", "consistency")
    return FigureSpec("pairs.make", f"{shows}, with predictions", PAIRS, keys, groups, idle=())


def _robustness(shows: str) -> FigureSpec:
    keys = (*OF_RUNS, "corruptions")
    return FigureSpec("robustness.make", shows, FAILING, keys, numbers="robustness.make_numbers")


FIGURES = {
    "spatialseg/fig1": FigureSpec(
        "maps.make_heats",
        "pixel-level IoU and sample occupancy, with centre, edge and mean",
        f"maps= (of rgbt score) for (a); {STATISTICS} for (b)",
        ("maps", "part", *SPATIAL),
        DATASET_AND_METRIC,
        idle=(),
    ),
    "spatialseg/fig2": FigureSpec(
        "trends.make",
        "IoU, accuracy and occupancy over vertical, horizontal and ring regions",
        f"methods=label:folder (of rgbt score); {STATISTICS}",
        ("methods", "regions", "absent", *SPATIAL),
        ("dataset",),
    ),
    "spatialseg/fig3": FigureSpec(
        "classes.make",
        "occupancy of each class by region, and the mIoU of a method",
        f"{STATISTICS}; methods=label:folder for the mIoU",
        ("methods", "part", "absent", *SPATIAL),
        DATASET_AND_METRIC,
        "ring9",
    ),
    "spatialseg/fig4": FigureSpec(
        "maps.make_regions",
        "the regions, numbered, over a heat map or an image; any partition with metric=",
        "maps=, statistics= or dataset= (with names=)",
        ("maps", "names", *SPATIAL),
        DATASET_AND_METRIC,
        "ring9",
    ),
    "spatialseg/fig5": FigureSpec(
        "image_quality.make_laplacian",
        "Laplacian variance by region: RGB and thermal, all, day, night",
        STATISTICS,
        SPATIAL,
        DATASET_AND_METRIC,
        "ring9",
    ),
    "spatialseg/fig6": FigureSpec(
        "image_quality.make_snr",
        "signal-to-noise ratio by region: RGB and thermal, all, day, night",
        STATISTICS,
        ("estimator", "average", *SPATIAL),
        DATASET_AND_METRIC,
        "ring9",
    ),
    "spatialseg/fig8": _panel("qualitative results"),
    "spatialseg/fig9": _panel("qualitative results on another data set"),
    "temporal/fig1": _pairs("a real frame and its synthesised next one, a row each"),
    "temporal/fig5": FigureSpec(
        "consistency.make",
        "TC and CA of variants by class",
        f"{RUNS}, with counts of pairs of frames (rgbt consistency)",
        ("frames", *OF_RUNS),
    ),
    "temporal/fig6": _pairs("four pairs of frames, real and synthesised, two columns each"),
    "crm/fig2": FigureSpec(
        "panels.make_missing",
        "predictions with both images, without RGB and without thermal",
        f"{PANELS}; without_rgb= and without_thermal= of the same methods",
        (*(key for key in PANEL_KEYS if key != "pick"), "without_rgb", "without_thermal"),
        ("dataset",),
    ),
    "crm/fig4": _panel("qualitative results"),
    "crm/fig5": FigureSpec(
        "masks.make",
        "masks: a square, and patches of 8, 16, 32 and 64 pixels, on a pair of images",
        "dataset=",
        ("names", "split", "patches", "seed"),
        ("dataset",),
    ),
    "multihead/fig3": FigureSpec(
        "gradients.make",
        "gradients of entropy minimisation and maximum squares loss",
        "no input: it is analytic",
    ),
    "robustness": _robustness(
        "mIoU under corruptions, one panel per corruption, one line per method"
    ),
    "robustness/relative": _robustness("the same in percent of the mIoU on clean images"),
    "regions/heat": FigureSpec(
        "profiles.make_heat",
        "mIoU of each region as a heat map, one per method",
        RUNS,
        (*OF_RUNS, "size"),
    ),
    "regions/profile": FigureSpec(
        "profiles.make_profile",
        "mIoU by region with intervals, one line per method",
        RUNS,
        (*OF_RUNS, "band", "resamples", "level", "blocks"),
    ),
}


def make(
    figure: str, values: dict[str, Any], overrides: list[str]
) -> tuple[Figure, Mapping[str, str]]:
    """The figure called `figure`, and its numbers as text by the ending of their file.

    Args:
        figure: a key of `FIGURES`.
        values: options that were given, by key.
        overrides: other ``key=value`` arguments.

    Raises:
        InputError: no such figure, a key that has no effect on it, or input that is missing or bad.
    """
    check_choice("figure", figure, FIGURES)
    spec = FIGURES[figure]
    words = [word.lstrip("+~").partition("=")[0] for word in overrides]
    idle = [key for key in values if key not in spec.keys]
    idle += [key for key in words if key.split(".")[0] not in spec.groups or key in spec.idle]
    if idle:
        known = ("figure", "out", *spec.keys, *spec.groups)
        raise InputError(
            f"'{idle[0]}' has no effect on figure={figure}; {nearest(idle[0], known)}."
        )
    given = FigureInput(figure, values, tuple(overrides), spec.metric)
    if not given.has_dataset:
        given.refuse([key for key in words if key.startswith("dataset.")], "dataset=...")
    numbers = _call(spec.numbers, given) if spec.numbers else {}
    return _call(spec.maker, given), numbers


def _call(name: str, given: FigureInput) -> Any:
    module, _, function = name.partition(".")
    return getattr(import_module(f"analysis.figures.{module}"), function)(given)
