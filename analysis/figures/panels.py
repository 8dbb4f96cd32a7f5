"""Qualitative panels: RGB, thermal, ground truth and methods, with a box on the centre.

One function for SpatialSeg Figs. 8 and 9, Temporal Fig. 6 and CRM Figs. 4 and 6 to 8. None of the
papers says how its images were chosen; here they are named, or chosen by a rule that is stated.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import (
    PAGE,
    SMALL,
    class_legend,
    folded,
    legend_height,
    new_figure,
    pack,
    show_image,
    styled,
)
from rgbt.checks import InputError
from rgbt.metrics.confusion import RegionCounter
from rgbt.metrics.counts import Counts, scored_classes
from rgbt.metrics.metric import Regions
from rgbt.metrics.regions import ring_rectangle
from rgbt.metrics.scores import miou

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from rgbt.dataset import LabelledDataset
    from rgbt.types import Sample

Labels = NDArray[np.uint8]
ReadPrediction = Callable[[str], Labels]
"""Name of an image -> (H, W) predicted class indices."""

RULES = ("first", "largest_difference")
"""``pick=``: the first of the split, or those where two methods differ most."""

WHOLE = Regions(partition="ring", regions=1, aspect="image", absent="exclude")
"""The image as one region."""

LAYOUTS = ("rows", "columns")
"""``layout=``: one row per image (SpatialSeg, CRM), or one column per image (Temporal)."""


@dataclass(frozen=True)
class PanelRow:
    """One image of a panel.

    Attributes:
        name: of the image.
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
    """A qualitative figure.

    Attributes:
        classes: K names.
        palette: (K, 3) uint8.
        box: rows and columns of the innermost region.
    """

    methods: tuple[str, ...]
    rows: tuple[PanelRow, ...]
    classes: tuple[str, ...]
    palette: Labels
    box: tuple[slice, slice]


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
    """The pictures of a panel.

    Args:
        dataset: holds the images.
        methods: label -> reader of its predictions.
        names: of the images, one per row.
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
    if sample.label is None:
        raise InputError(f"names: '{sample.name}' has no label; choose images that are labelled.")
    predictions = {label: read(sample.name) for label, read in methods.items()}
    for label, prediction in predictions.items():
        check_size(sample.name, label, sample.label, prediction)
    whole = RegionCounter(len(scored), WHOLE)
    matrices = [whole(sample.label, each).sum(0) for each in predictions.values()]
    return PanelRow(
        name=sample.name,
        rgb=sample.rgb,
        thermal=sample.thermal,
        label=sample.label,
        predictions=tuple(predictions.values()),
        mious=tuple(float(100 * miou(each, "exclude", scored)) for each in matrices),
    )


def check_size(name: str, method: str, label: Labels, prediction: Labels) -> None:
    """Raise InputError unless a prediction has the size of the label."""
    if prediction.shape != label.shape:
        raise InputError(
            f"methods: the prediction of '{name}' by '{method}' is {prediction.shape[0]}x"
            f"{prediction.shape[1]} pixels but its label is {label.shape[0]}x{label.shape[1]}; "
            "save predictions at the size of the labels."
        )


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
        raise InputError("pick=largest_difference compares two methods; name two in methods=...")
    first, *_, last = mious.values()
    gaps = {name: abs(last[name] - first[name]) for name in names}
    known = [name for name, gap in gaps.items() if not np.isnan(gap)]
    if len(known) < number:
        raise InputError(f"rows={number}, but there are only {len(known)} images to choose from.")
    return tuple(sorted(known, key=lambda name: -gaps[name])[:number])


@styled
def draw(data: QualitativePanel, layout: str = "rows") -> Figure:
    """Pictures with a white box on the centre; below them the classes."""
    plain = ("RGB", "thermal", "ground truth", *data.methods)
    height, width = data.rows[0].thermal.shape
    shape = (len(data.rows), len(plain))
    lines, columns = shape if layout == "rows" else shape[::-1]
    cell = (PAGE - 0.25) / columns
    legend = legend_height(PAGE, len(data.classes))
    titles = [folded(title, cell if layout == "rows" else cell * height / width) for title in plain]
    folds = 0.14 * max(title.count("\n") for title in titles) if layout == "rows" else 0.0
    figure = new_figure(PAGE, lines * (cell * height / width + 0.02) + 0.2 + folds + legend)
    pack(figure)
    grid = figure.subplots(lines, columns, squeeze=False)
    axes = grid if layout == "rows" else grid.T
    for line, row in zip(axes, data.rows, strict=True):
        _draw_row(line, row, data)
    names = [row.name for row in data.rows]
    above, beside = (titles, names) if layout == "rows" else (names, titles)
    for each, title in zip(grid[0], above, strict=True):
        each.set_title(title)
    for each, title in zip(grid[:, 0], beside, strict=True):
        each.set_ylabel(title, fontsize=SMALL)
    class_legend(figure, data.classes, data.palette)
    return figure


def _draw_row(axes: Sequence[Axes], row: PanelRow, data: QualitativePanel) -> None:
    from matplotlib.patches import Rectangle

    from rgbt.tracking.pictures import colours

    thermal = np.repeat(row.thermal[..., None], 3, axis=2)
    painted = [colours(each, data.palette) for each in (row.label, *row.predictions)]
    rows, columns = data.box
    corner = (columns.start - 0.5, rows.start - 0.5)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    for each, picture in zip(axes, (row.rgb, thermal, *painted), strict=True):
        show_image(each, picture)
        for colour, width in (("black", 1.4), ("white", 0.8)):
            each.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=width))
