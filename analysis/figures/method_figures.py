"""Figures of one's own methods: robustness, heat maps and profiles by region.

Everything heavy is imported when a figure is made, so that the list of figures is there at once.
"""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Any

from analysis.bar import progress
from analysis.figures.figure_spec import OF_RUNS, RUNS, FigureSpec, figure
from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError, split_list

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.figures.profiles import Profile
    from analysis.figures.robustness import Panel

LEAST, MOST_PIXELS = 16, 4096
"""Pixels of a side of ``size=``."""

FAILING = "runs= (run, group or folder of rgbt robustness, with labels: label:run)"

LONGEST = 8
"""Times that one side of ``size=`` may be the other."""


def robustness_numbers(given: FigureInput) -> dict[str, str]:
    """The numbers of both."""
    from analysis.figures.robustness import numbers

    return numbers(_failing(given))


def _robustness(name: str, shows: str, *, relative: bool) -> FigureSpec:
    def make(given: FigureInput) -> Figure:
        from analysis.figures.robustness import draw

        return draw(_failing(given), relative=relative)

    return FigureSpec(
        name=name,
        shows=shows,
        needs=FAILING,
        keys=(*OF_RUNS, "corruptions"),
        make=make,
        numbers=robustness_numbers,
    )


robustness = _robustness(
    "robustness",
    "mIoU under corruptions, one panel per corruption, one line per method",
    relative=False,
)
robustness_relative = _robustness(
    "robustness/relative", "the same in percent of the mIoU on clean images", relative=True
)


def _failing(given: FigureInput) -> tuple[Panel, ...]:
    from analysis.figures.robustness import panels
    from analysis.robustness import trainings

    found = given.opened_runs("runs or groups; label:run names one", trainings)
    named = given.get("corruptions", "")
    rows = split_list(named, "corruptions") if named else []
    levels = (level for each in found.values() for training in each for level in training.levels)
    return panels(found, given.absent(level.counts for level in levels), rows)


@figure(
    "regions/heat",
    "mIoU of each region as a heat map, one per method",
    RUNS,
    keys=(*OF_RUNS, "size"),
)
def region_heat(given: FigureInput) -> Figure:
    """Regions painted by their mIoU."""
    from analysis.figures import profiles, regions

    image_hw = _image_hw(given.get("size", "480x640"))
    runs = given.runs()
    absent = given.absent(counts for seeds in runs.values() for counts in seeds)
    methods = [profiles.means_only(label, seeds, absent) for label, seeds in runs.items()]
    return regions.draw_heat(regions.region_heat(methods, image_hw))


def _image_hw(size: str) -> tuple[int, int]:
    match = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", size)
    height, width = map(int, match.groups()) if match else (0, 0)
    if not (LEAST <= height <= MOST_PIXELS and LEAST <= width <= MOST_PIXELS):
        raise InputError(
            f"size must be HEIGHTxWIDTH with {LEAST} to {MOST_PIXELS} pixels each, such as 480x640,"
            f" got '{size}'."
        )
    if max(height, width) > LONGEST * min(height, width):
        raise InputError(f"size={size}: one side is more than {LONGEST} times the other.")
    return height, width


@figure(
    "regions/profile",
    "mIoU by region with intervals, one line per method",
    RUNS,
    keys=(*OF_RUNS, "band", "resamples", "level", "blocks"),
)
def region_profile(given: FigureInput) -> Figure:
    """MIoU over the regions with bands."""
    from analysis.figures.profiles import draw_profiles

    return draw_profiles(_profiles(given))


def _profiles(given: FigureInput) -> list[Profile]:
    from analysis.figures.profiles import BANDS, profile
    from analysis.uncertainty import Resampling

    band: Any = given.get("band", BANDS[0])
    methods = given.runs()
    settings = Resampling(
        resamples=given.get("resamples", 10_000),
        level=given.get("level", 0.95),
        blocks=given.get("blocks", "auto"),
        absent=given.absent(counts for seeds in methods.values() for counts in seeds),
    )
    made = []
    with progress("resampling", len(methods)) as advance:
        for label, seeds in methods.items():
            made.append(profile(label, seeds, settings, band))
            advance()
    return made
