"""Qualitative panels: images, ground truth and the predictions of several methods."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.bar import progress
from analysis.figures.figure_spec import DATASET_AND_METRIC, FigureSpec
from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from analysis.figures.panels import ReadPrediction
    from analysis.predictions.images import PredictionReader

PREDICTIONS = "label:folder of predicted label images, with commas between methods"


def qualitative(name: str, shows: str) -> FigureSpec:
    """The declaration of a qualitative panel."""
    return FigureSpec(
        name=name,
        shows=shows,
        needs="dataset=, methods=label:folder of predictions",
        keys=("methods", "names", "pick", "rows", "split", "layout", "format", "suffix"),
        groups=DATASET_AND_METRIC,
        make=draw_panel,
    )


def draw_panel(given: FigureInput) -> Figure:
    """Images, ground truth and predictions."""
    from analysis.figures import panels
    from analysis.predictions.images import PredictionReader
    from rgbt.tracking.terminal import info

    folders = {
        label: Path(place).expanduser()
        for label, place in given.named("methods", PREDICTIONS).items()
    }
    layout = given.get("layout", panels.LAYOUTS[0])
    form: Any = given.get("format", "auto")
    dataset = given.dataset
    reader = PredictionReader(dataset.classes, dataset.palette, form)
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
        info(f"{row.name}: " + ", ".join(f"{label} mIoU {each:.1f}" for label, each in scores))
    return panels.draw(made, layout)


def _most_different(given: FigureInput, folders: dict[str, Path], form: Any) -> tuple[str, ...]:
    from analysis.figures.panels import image_mious, most_different
    from analysis.predictions.scoring import ScoringOptions, score_folder

    split = given.get("split", "test")
    options = ScoringOptions(
        partitions=("ring",), regions=1, form=form, suffix=given.get("suffix", "")
    )
    mious = {}
    with progress("comparing", len(folders) * len(given.dataset.names(split))) as advance:
        for label, folder in folders.items():
            (counts,) = score_folder(folder, given.dataset, split, options, advance).counts
            mious[label] = image_mious(counts)
    return most_different(mious, given.dataset.names(split), given.get("rows", 4))


def _reading(folder: Path, reader: PredictionReader, suffix: str) -> ReadPrediction:
    def read(name: str) -> Any:
        path = folder / f"{name}{suffix}.png"
        if not path.is_file():
            raise InputError(
                f"methods: there is no prediction {path}; name a folder that holds NAME{suffix}.png"
                " for every image shown, or other images with names=..."
            )
        return reader.read(path)

    return read
