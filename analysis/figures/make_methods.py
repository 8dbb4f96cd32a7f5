"""From arguments to figures of methods: qualitative panels, heat maps and profiles by region."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.bar import progress
from analysis.figures.inputs import Given
from rgbt.checks import InputError, split_list

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.figures.panels import ReadPrediction
    from analysis.figures.profiles import Profile
    from analysis.figures.robustness import Panel
    from analysis.predictions.images import Reader

LEAST, MOST_PIXELS = 16, 4096
"""Pixels of a side of ``size=``."""

LONGEST = 8
"""Times that one side of ``size=`` may be the other."""

PREDICTIONS = "label:folder of predicted label images, with commas between methods"


def panel(given: Given) -> Figure:
    """Images, ground truth and predictions."""
    from analysis.figures import panels
    from analysis.predictions.images import Reader
    from rgbt.tracking.terminal import tell

    folders = {
        label: Path(place).expanduser()
        for label, place in given.named("methods", PREDICTIONS).items()
    }
    layout = given.get("layout", panels.LAYOUTS[0])
    form: Any = given.get("format", "auto")
    dataset = given.dataset
    reader = Reader(dataset.classes, dataset.palette, form)
    rule = given.get("pick", panels.RULES[0])
    if "names" in given.values and ("pick" in given.values or "rows" in given.values):
        raise InputError("names= says which images are shown; leave pick= and rows= out.")
    if rule == "largest_difference":
        names = _most_different(given, folders, form)
    else:
        names = given.names(given.get("rows", 4))
    suffix = given.get("suffix", "")
    readers = {label: _reading(folder, reader, suffix) for label, folder in folders.items()}
    made = panels.panel(dataset, readers, names, given.regions)
    for row in made.rows:
        scores = zip(made.methods, row.mious, strict=True)
        tell(f"{row.name}: " + ", ".join(f"{label} mIoU {each:.1f}" for label, each in scores))
    return panels.draw(made, layout)


def _most_different(given: Given, folders: dict[str, Path], form: Any) -> tuple[str, ...]:
    from analysis.figures.panels import image_mious, most_different
    from analysis.predictions.scoring import Options, score_folder

    split = given.get("split", "test")
    options = Options(partitions=("ring",), regions=1, form=form, suffix=given.get("suffix", ""))
    mious = {}
    with progress("comparing", len(folders) * len(given.dataset.names(split))) as advance:
        for label, folder in folders.items():
            (counts,) = score_folder(folder, given.dataset, split, options, advance).counts
            mious[label] = image_mious(counts)
    return most_different(mious, given.dataset.names(split), given.get("rows", 4))


def _reading(folder: Path, reader: Reader, suffix: str) -> ReadPrediction:
    def read(name: str) -> Any:
        path = folder / f"{name}{suffix}.png"
        if not path.is_file():
            raise InputError(
                f"methods: there is no prediction {path}; name a folder that holds NAME{suffix}.png"
                " for every image shown, or other images with names=..."
            )
        return reader.read(path)

    return read


def region_heat(given: Given) -> Figure:
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


def robustness(given: Given) -> Figure:
    """MIoU as images fail."""
    from analysis.figures.robustness import draw

    return draw(_failing(given), relative=False)


def robustness_relative(given: Given) -> Figure:
    """The same in percent of the clean mIoU."""
    from analysis.figures.robustness import draw

    return draw(_failing(given), relative=True)


def robustness_numbers(given: Given) -> dict[str, str]:
    """The numbers of both."""
    from analysis.figures.robustness import numbers

    return numbers(_failing(given))


def _failing(given: Given) -> tuple[Panel, ...]:
    from analysis.figures.robustness import panels
    from analysis.robustness import Training, trainings

    runs_dir, split = given.get("runs_dir", "runs"), given.get("split", "")
    found: dict[str, list[Training]] = {}
    what = "runs or groups; label:run names one"
    for word in split_list(given.need("runs", what), what):
        label, colon, place = word.partition(":")
        for each in trainings(place if colon else label, Path(runs_dir).expanduser(), split):
            found.setdefault(label if colon else each.label, []).append(each)
    named = given.get("corruptions", "")
    rows = split_list(named, "corruptions") if named else []
    levels = (level for each in found.values() for training in each for level in training.levels)
    return panels(found, given.absent(level.counts for level in levels), rows)


def region_profile(given: Given) -> Figure:
    """MIoU over the regions with bands."""
    from analysis.figures.profiles import draw_profiles

    return draw_profiles(_profiles(given))


def _profiles(given: Given) -> list[Profile]:
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
