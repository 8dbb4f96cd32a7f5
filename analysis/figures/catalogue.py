"""All figures by name: what each shows, what it is made from, which keys it takes."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analysis.figures import make_methods, make_papers
from analysis.figures.inputs import Given
from rgbt.checks import InputError, check_choice, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True)
class Entry:
    """One figure.

    Attributes:
        shows: one line.
        needs: what must be given, in words.
        keys: keys that take effect, beside ``figure`` and ``out``.
        groups: groups of the configuration that take effect.
        make: draws it.
        metric: the partition unless ``metric=`` is given.
        idle: keys of the configuration below `groups` that take no effect nevertheless.
        numbers: what it shows as text, written beside it by the ending of the file; None: nothing.
    """

    shows: str
    needs: str
    keys: tuple[str, ...]
    groups: tuple[str, ...]
    make: Callable[[Given], Figure]
    metric: str = "ring5"
    idle: tuple[str, ...] = ("metric.absent",)
    numbers: Callable[[Given], Mapping[str, str]] | None = None


STATISTICS = "statistics= (of analysis.spatial) or dataset="
SPATIAL = ("statistics", "split")
QUALITATIVE = "dataset=, methods=label:folder of predictions"
PANEL = ("methods", "names", "pick", "rows", "split", "layout", "format", "suffix")
RUNS = "runs= (run, group or counts, with labels: label:run)"
OF_RUNS = ("runs", "runs_dir", "split", "absent")
FAILING = (
    "runs= (run, group or folder of python -m rgbt.robustness, with labels: label:run)",
    (*OF_RUNS, "corruptions"),
    (),
)
OF_INTERVALS = ("band", "resamples", "level", "blocks")
BOTH = ("dataset", "metric")


def _panel(shows: str) -> Entry:
    return Entry(shows, QUALITATIVE, PANEL, BOTH, make_methods.panel)


FIGURES: dict[str, Entry] = {
    "spatialseg/fig1": Entry(
        "pixel-level IoU and sample occupancy, with centre, edge and mean",
        f"maps= (of analysis.score) for (a); {STATISTICS} for (b)",
        ("maps", "part", *SPATIAL),
        BOTH,
        make_papers.spatialseg_fig1,
        idle=(),
    ),
    "spatialseg/fig2": Entry(
        "IoU, accuracy and occupancy over vertical, horizontal and ring regions",
        f"methods=label:folder (of analysis.score); {STATISTICS}",
        ("methods", "regions", "absent", *SPATIAL),
        ("dataset",),
        make_papers.spatialseg_fig2,
    ),
    "spatialseg/fig3": Entry(
        "occupancy of each class by region, and the mIoU of a method",
        f"{STATISTICS}; methods=label:folder for the mIoU",
        ("methods", "part", "absent", *SPATIAL),
        BOTH,
        make_papers.spatialseg_fig3,
        metric="ring9",
    ),
    "spatialseg/fig4": Entry(
        "the regions, numbered, over a heat map or an image; any partition with metric=",
        "maps=, statistics= or dataset= (with names=)",
        ("maps", "names", *SPATIAL),
        BOTH,
        make_papers.spatialseg_fig4,
        metric="ring9",
    ),
    "spatialseg/fig5": Entry(
        "Laplacian variance by region: RGB and thermal, all, day, night",
        STATISTICS,
        SPATIAL,
        BOTH,
        make_papers.spatialseg_fig5,
        metric="ring9",
    ),
    "spatialseg/fig6": Entry(
        "signal-to-noise ratio by region: RGB and thermal, all, day, night",
        STATISTICS,
        ("estimator", "average", *SPATIAL),
        BOTH,
        make_papers.spatialseg_fig6,
        metric="ring9",
    ),
    "spatialseg/fig8": _panel("qualitative results"),
    "spatialseg/fig9": _panel("qualitative results on another data set"),
    "temporal/fig5": Entry(
        "TC and CA of variants by class",
        f"{RUNS}, with counts of pairs of frames (python -m rgbt.consistency)",
        ("frames", *OF_RUNS),
        (),
        make_papers.temporal_fig5,
    ),
    "temporal/fig6": _panel("qualitative results, one column per image with layout=columns"),
    "crm/fig4": _panel("qualitative results"),
    "crm/fig5": Entry(
        "masks: a square, and patches of 8, 16, 32 and 64 pixels, on a pair of images",
        "dataset=",
        ("names", "split", "patches", "seed"),
        ("dataset",),
        make_papers.crm_fig5,
    ),
    "multihead/fig3": Entry(
        "gradients of entropy minimisation and maximum squares loss",
        "nothing: analytic",
        (),
        (),
        make_papers.multihead_fig3,
    ),
    "robustness": Entry(
        "mIoU under corruptions, one panel per corruption, one line per method",
        *FAILING,
        make_methods.robustness,
        numbers=make_methods.robustness_numbers,
    ),
    "robustness/relative": Entry(
        "the same in percent of the mIoU on clean images",
        *FAILING,
        make_methods.robustness_relative,
        numbers=make_methods.robustness_numbers,
    ),
    "regions/heat": Entry(
        "mIoU of each region as a heat map, one per method",
        RUNS,
        (*OF_RUNS, "size"),
        (),
        make_methods.region_heat,
    ),
    "regions/profile": Entry(
        "mIoU by region with intervals, one line per method",
        RUNS,
        (*OF_RUNS, *OF_INTERVALS),
        (),
        make_methods.region_profile,
    ),
}


def make(
    figure: str, values: dict[str, Any], overrides: list[str]
) -> tuple[Figure, Mapping[str, str]]:
    """The figure called `figure`, and its numbers as text by the ending of their file.

    Args:
        figure: a key of `FIGURES`.
        values: key -> value of the options that were given.
        overrides: other ``key=value`` arguments.

    Raises:
        InputError: no such figure, a key that has no effect on it, or input that is missing or bad.
    """
    check_choice("figure", figure, FIGURES)
    entry = FIGURES[figure]
    words = [word.lstrip("+~").partition("=")[0] for word in overrides]
    idle = [key for key in values if key not in entry.keys]
    idle += [key for key in words if key.split(".")[0] not in entry.groups or key in entry.idle]
    if idle:
        known = ("figure", "out", *entry.keys, *entry.groups)
        raise InputError(
            f"'{idle[0]}' has no effect on figure={figure}; {nearest(idle[0], known)}."
        )
    given = Given(figure, values, tuple(overrides), entry.metric)
    if not given.has_dataset:
        given.refuse([key for key in words if key.startswith("dataset.")], "dataset=...")
    return entry.make(given), {} if entry.numbers is None else entry.numbers(given)
