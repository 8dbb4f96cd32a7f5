"""Qualitative panels: RGB, thermal, ground truth and methods, with a box on the centre.

One function for SpatialSeg Figs. 8 and 9, Temporal Fig. 6 and CRM Figs. 4 and 6 to 8. None of the
papers says how its images were chosen. Here they are named, or selected by a stated rule.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.bar import progress
from analysis.figures import style
from analysis.figures.grid import Grid, Texts, draw_grid
from analysis.figures.inputs import FigureInput
from analysis.predictions.scoring import ScoringOptions, score_folder
from rgbt.checks import InputError
from rgbt.data.predictions import Affixes, FormatOptions, PredictionReader, prediction_paths
from rgbt.metrics.counting import RegionCounter
from rgbt.metrics.counts import Counts, scored_classes
from rgbt.metrics.metric import Regions, ring_rectangle
from rgbt.metrics.scores import miou
from rgbt.terminal import info
from rgbt.tracking.pictures import colours

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset
    from rgbt.types import Sample

Labels = NDArray[np.uint8]
ReadPrediction = Callable[[str], Labels]
"""Name of an image -> (H, W) predicted class indices."""

PREDICTIONS = "label:folder of predicted label images, with commas between methods"

MISSING = {"without_rgb": "no RGB", "without_thermal": "no thermal"}
"""Option with the predictions without an image -> what they are called."""

LINE = "\n"

WHOLE = Regions(partition="ring", regions=1, aspect="image", absent="exclude")
"""The image as one region."""


@dataclass(frozen=True)
class PanelRow:
    """One image of a panel.

    Attributes:
        rgb: (H, W, 3) uint8.
        thermal: (H, W) uint8.
        label: (H, W) class indices or 255.
        predictions: (H, W) class indices of each method.
        mious: of this image alone, percent, one per method; over the scored classes that label or
            prediction hold, because a single image lacks most classes.
    """

    name: str
    rgb: Labels
    thermal: Labels
    label: Labels
    predictions: tuple[Labels, ...]
    mious: tuple[float, ...]


@dataclass(frozen=True)
class QualitativePanel:
    """A qualitative figure, with a box on the rows and columns of the innermost region."""

    methods: tuple[str, ...]
    rows: tuple[PanelRow, ...]
    classes: tuple[str, ...]
    palette: Labels
    box: tuple[slice, slice]


def make(given: FigureInput) -> Figure:
    """Images, ground truth and predictions."""
    made = _read(given, given.named("methods", PREDICTIONS), 4)
    return draw(made, given.get("layout", "rows"))


def make_missing(given: FigureInput) -> Figure:
    """CRM, Fig. 2: predictions with both images, without RGB and without thermal.

    Raises:
        InputError: methods whose three folders are not all named.
    """
    folders = {key: given.named(key, PREDICTIONS) for key in ("methods", *MISSING)}
    for key, named in folders.items():
        if set(named) != set(folders["methods"]):
            raise InputError(
                f"{key} names the predictions of {', '.join(named)}, but methods those of "
                f"{', '.join(folders['methods'])}; give every method in methods=, without_rgb= and "
                "without_thermal=."
            )
    shown = {"methods": "both", **MISSING}
    named = {
        f"{label}\n{shown[key]}": folders[key][label]
        for label in folders["methods"]
        for key in shown
    }
    return draw(_read(given, named, 2), given.get("layout", "rows"), marks="scores")


def _reading(
    folder: Path, names: Sequence[str], dataset: LabelledDataset, described: FormatOptions
) -> ReadPrediction:
    """A function that reads the prediction of one of the images.

    Raises:
        InputError: an image without a prediction, or an unknown format.
    """
    paths = prediction_paths(folder, names, described.affixes)
    for path in paths.values():
        if not path.is_file():
            raise InputError(
                f"methods: there is no prediction {path}; name a folder with a file for every "
                "image shown, or other images with names=..."
            )
    reader = PredictionReader(dataset.classes, dataset.palette, described)
    return lambda name: reader.read(paths[name])


def _read(given: FigureInput, named: Mapping[str, str], number: int) -> QualitativePanel:
    """The panel of folders of predictions by label, of `number` images unless they are named."""
    folders = {label: Path(place).expanduser() for label, place in named.items()}
    dataset = given.dataset
    described = FormatOptions(
        form=given.get("format", "index"),
        palette=given.get("palette", "dataset"),
        affixes=Affixes(given.get("prefix", ""), given.get("suffix", "")),
    )
    if "names" in given.values and ("pick" in given.values or "rows" in given.values):
        raise InputError("names= selects the images; omit pick= and rows=.")
    names = given.names(given.get("rows", number))
    if given.get("pick", "first") == "largest_difference":
        split = given.get("split", "test")
        options = ScoringOptions(partitions=("ring",), regions=1, format=described)
        mious = {}
        with progress("comparing", len(folders) * len(dataset.names(split))) as advance:
            for label, folder in folders.items():
                (counts,) = score_folder(folder, dataset, split, options, advance).counts
                mious[label] = image_mious(counts)
        names = most_different(mious, dataset.names(split), given.get("rows", number))
    readers = {
        label: _reading(folder, names, dataset, described) for label, folder in folders.items()
    }
    made = panel(dataset, readers, names, given.regions)
    for row in made.rows:
        scores = zip(made.methods, row.mious, strict=True)
        said = (f"{label.replace(LINE, ' ')} mIoU {each:.1f}" for label, each in scores)
        info(f"{row.name}: {', '.join(said)}")
    return made


def image_mious(counts: Counts) -> dict[str, float]:
    """Name -> mIoU of that image alone, percent, over the scored classes in it (else NaN)."""
    scores = 100 * miou(counts.counts.sum(1), "exclude", counts.scored)
    return dict(zip(counts.names, scores.tolist(), strict=True))


def panel(
    dataset: LabelledDataset,
    methods: Mapping[str, ReadPrediction],
    names: Sequence[str],
    regions: Regions,
) -> QualitativePanel:
    """The pictures of a panel, one row per name.

    Args:
        dataset: holds the images.
        methods: label -> reader of its predictions.
        names: of the images.
        regions: rings; the box is around the innermost.

    Raises:
        InputError: no rings, images that differ in size, or a prediction of another size.
    """
    samples = [dataset.read(name) for name in names]
    sizes = {sample.thermal.shape for sample in samples}
    if len(sizes) > 1:
        raise InputError(f"names: the images have different sizes {sorted(sizes)}; show one size.")
    if regions.aspect is None:
        raise InputError(
            f"metric.partition={regions.partition} has no centre to put a box on; use rings, for "
            "example metric=ring5."
        )
    height, width = samples[0].thermal.shape
    scored = scored_classes(dataset.classes, dataset.unscored)
    return QualitativePanel(
        methods=tuple(methods),
        rows=tuple(_row(sample, methods, scored) for sample in samples),
        classes=tuple(dataset.classes),
        palette=np.array(dataset.palette, np.uint8),
        box=ring_rectangle((height, width), regions.regions, 1, regions.aspect),
    )


def _row(
    sample: Sample, methods: Mapping[str, ReadPrediction], scored: NDArray[np.bool_]
) -> PanelRow:
    label = sample.label
    if label is None:
        raise InputError(f"names: '{sample.name}' has no label; choose images that are labelled.")
    predictions = {method: read(sample.name) for method, read in methods.items()}
    for method, each in predictions.items():
        if each.shape != label.shape:
            raise InputError(
                f"methods: the prediction of '{sample.name}' by '{method}' is {each.shape[0]}x"
                f"{each.shape[1]} pixels but its label is {label.shape[0]}x{label.shape[1]}; "
                "save predictions at the size of the labels."
            )
    whole = RegionCounter(len(scored), WHOLE)
    matrices = [whole(label, each).sum(0) for each in predictions.values()]
    mious = tuple(float(100 * miou(each, "exclude", scored)) for each in matrices)
    images = sample.rgb, sample.thermal, label
    return PanelRow(sample.name, *images, tuple(predictions.values()), mious)


def most_different(
    mious: Mapping[str, Mapping[str, float]], names: Sequence[str], number: int
) -> tuple[str, ...]:
    """Names of the images where the last method differs most from the first.

    Args:
        mious: method -> name -> mIoU of that image, percent; images with a NaN are left out.
        names: of the split, in order.
        number: how many.

    Returns:
        names by falling ``|last - first|``; equal ones in the order of the split.

    Raises:
        InputError: fewer than two methods, or fewer images than requested.
    """
    if len(mious) < 2:
        raise InputError("pick=largest_difference compares two methods; give two in methods=...")
    first, *_, last = mious.values()
    gaps = {name: abs(last[name] - first[name]) for name in names}
    known = [name for name, gap in gaps.items() if not np.isnan(gap)]
    if len(known) < number:
        raise InputError(f"rows={number}, but there are only {len(known)} images to choose from.")
    return tuple(sorted(known, key=lambda name: -gaps[name])[:number])


@style.styled
def draw(
    data: QualitativePanel, layout: str = "rows", marks: Literal["box", "scores"] = "box"
) -> Figure:
    """Pictures; below them the classes.

    Args:
        data: images and predictions.
        layout: a row or a column per image.
        marks: a white box on the centre, or the mIoU of every prediction.
    """
    titles = ("RGB", "thermal", "ground truth", *data.methods)
    pictures = []
    for row in data.rows:
        thermal = np.repeat(row.thermal[..., None], 3, axis=2)
        painted = [colours(each, data.palette) for each in (row.label, *row.predictions)]
        pictures.append((row.rgb, thermal, *painted))
    names = [row.name for row in data.rows]
    grid = draw_grid(pictures, Texts(names, titles, data.classes, data.palette), layout)
    if marks == "scores":
        for row, cells in zip(data.rows, grid.cells, strict=True):
            for axes, miou_of_image in zip(cells[3:], row.mious, strict=True):
                style.in_corner(axes, f"{miou_of_image:.1f}")
        return grid.figure
    _box(grid, data.box)
    return grid.figure


def _box(grid: Grid, box: tuple[slice, slice]) -> None:
    """A white box on the same rows and columns of every picture."""
    from matplotlib.patches import Rectangle

    box_rows, box_columns = box
    corner = (box_columns.start - 0.5, box_rows.start - 0.5)
    size = (box_columns.stop - box_columns.start, box_rows.stop - box_rows.start)
    for each in (axes for row in grid.cells for axes in row):
        for colour, edge in (("black", 1.4), ("white", 0.8)):
            each.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=edge))
