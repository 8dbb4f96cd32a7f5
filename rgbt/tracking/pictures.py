"""Draw the pictures of a run: qualitative panel, region heat map, label overlay.

Matplotlib is imported when something is drawn and never opens a window.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from rgbt.dataset import LabelledDataset, background_indices
from rgbt.files.atomic import replacing
from rgbt.types import IGNORE, Sample

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Image = NDArray[np.uint8]

# Pixels without a label are grey: black is a class in most palettes.
IGNORED_COLOUR = (128, 128, 128)

# Width of a letter of eight points, on average.
LETTER_INCHES = 0.07

# Pictures of an example, from left to right.
COLUMNS = ("RGB", "thermal", "ground truth", "prediction")

# Percent points from the mean region to either end of the heat map's colours, at least.
HALF_SPAN = 15.0


def palette_of(dataset: LabelledDataset) -> Image:
    """Return the colours of the classes of a data set, (K, 3) RGB."""
    return np.array(dataset.palette, np.uint8)


def colours(label: Image, palette: Image) -> Image:
    """Paint classes (H, W) uint8 in colours of a palette (K, 3): (H, W, 3); 255: `IGNORED_COLOUR`.

    Raises:
        ValueError: a label is neither below K nor 255.
    """
    table = np.full((256, 3), IGNORED_COLOUR, np.uint8)
    table[: len(palette)] = palette
    odd = (label >= len(palette)) & (label != IGNORE)
    if odd.any():
        raise ValueError(f"label {label[odd][0]} has no colour; the palette has {len(palette)}.")
    return np.asarray(table[label])


def overlay(rgb: Image, label: Image, dataset: LabelledDataset, alpha: float = 0.6) -> Image:
    """Paint classes (H, W) over an image (H, W, 3); background classes and 255 stay unpainted.

    out = round((1 - alpha) * rgb + alpha * palette[label])
    """
    mixed = (1.0 - alpha) * rgb + alpha * colours(label, palette_of(dataset))
    unpainted = np.isin(label, (*background_indices(dataset), IGNORE))[..., None]
    return np.where(unpainted, rgb, np.rint(mixed)).astype(np.uint8)


def draw_panel(
    examples: Sequence[tuple[Sample, Image]], dataset: LabelledDataset, path: Path
) -> None:
    """Write a PNG: one row per example; RGB, thermal, ground truth, prediction; classes below.

    An example is a sample and its predicted classes, at the size of its label.
    """
    rows = [(sample.name, _row(sample, classes, dataset)) for sample, classes in examples]
    draw_columns(rows, COLUMNS, dataset, path)


def _row(sample: Sample, prediction: Image, dataset: LabelledDataset) -> list[Image]:
    """The pictures (H, W, 3) of `COLUMNS`."""
    palette = palette_of(dataset)
    label = np.full_like(prediction, IGNORE) if sample.label is None else sample.label
    thermal = np.repeat(sample.thermal[..., None], 3, axis=2)
    return [sample.rgb, thermal, colours(label, palette), colours(prediction, palette)]


def write_strip(sample: Sample, prediction: Image, dataset: LabelledDataset, path: Path) -> None:
    """Write the pictures of `COLUMNS` side by side, (H, 4 W, 3), as a PNG without letters.

    Its text chunk "image" is the name of the image, "classes" JSON: a list of [name, red, green,
    blue], because not every configuration has the palette.
    """
    from PIL import Image as Pillow
    from PIL.PngImagePlugin import PngInfo

    named = zip(dataset.classes, dataset.palette, strict=True)
    legend = [(name, *map(int, colour)) for name, colour in named]
    texts = PngInfo()
    texts.add_itxt("image", sample.name)
    texts.add_itxt("classes", json.dumps(legend))
    strip = np.concatenate(_row(sample, prediction, dataset), axis=1)
    with replacing(path) as file:
        Pillow.fromarray(strip).save(file, format="png", pnginfo=texts)


def draw_columns(
    rows: Sequence[tuple[str, Sequence[Image]]],
    titles: Sequence[str],
    dataset: LabelledDataset,
    path: Path,
) -> None:
    """Write a PNG of `rows`, (name, one (H, W, 3) picture per column), with the classes below."""
    height, width = rows[0][1][0].shape[:2]
    cell_w = 3.0
    cell_h = cell_w * height / width
    figure = _figure(len(titles) * cell_w + 0.4, len(rows) * (cell_h + 0.08) + 0.75)
    axes = figure.subplots(len(rows), len(titles), squeeze=False)
    for row, (name, pictures) in zip(axes, rows, strict=True):
        for axis, picture in zip(row, pictures, strict=True):
            axis.imshow(picture, interpolation="nearest")
            axis.set(xticks=[], yticks=[])
            axis.spines[:].set_visible(False)
        row[0].set_ylabel(_broken(name, int(cell_h / LETTER_INCHES)), fontsize=8)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=10)
    from matplotlib.patches import Patch

    patches = [
        Patch(facecolor=colour / 255.0, edgecolor="grey", label=name)
        for name, colour in zip(dataset.classes, palette_of(dataset), strict=True)
    ]
    figure.legend(
        handles=patches, loc="outside lower center", ncols=min(len(patches), 9), fontsize=8
    )
    with replacing(path) as file:
        figure.savefig(file, format="png")


def _broken(name: str, letters: int) -> str:
    """A name in lines of at most `letters`, broken after "_" where it can be."""
    lines = [""]
    for word in re.findall(r"[^_]*_|[^_]+", name):
        if lines[-1] and len(lines[-1] + word) > letters:
            lines.append("")
        lines[-1] += word
    return "\n".join(lines)


def number_places(
    region_map: NDArray[np.integer], num_regions: int
) -> list[tuple[int, int] | None]:
    """Return (row, column) in each region where a number is easy to read; None: it is empty.

    The pixel nearest to the region's mean, above the middle row where that is in another region.
    """
    places: list[tuple[int, int] | None] = []
    for region in range(num_regions):
        rows, columns = np.nonzero(region_map == region)
        if len(rows) == 0:
            places.append(None)
            continue
        centre = np.array([rows.mean(), columns.mean()])
        if region_map[tuple(np.rint(centre).astype(int))] != region:
            upper = rows < centre[0]
            near = np.abs(columns - centre[1]) < 1
            centre = np.array([np.median(rows[upper & near]), centre[1]])
        nearest = np.argmin((rows - centre[0]) ** 2 + (columns - centre[1]) ** 2)
        places.append((int(rows[nearest]), int(columns[nearest])))
    return places


def colour_limits(ious: Sequence[float]) -> tuple[float, float]:
    """Return the ends of the colour scale in percent, equally far from the mean region.

    At least `HALF_SPAN`, so that pictures of most runs can be compared. Without a score: around 50.
    """
    percents = 100.0 * np.asarray(ious, np.float64)
    known = percents[~np.isnan(percents)]
    mean = float(known.mean()) if known.size else 50.0
    half = max(HALF_SPAN, float(np.abs(known - mean).max(initial=0.0)))
    return mean - half, mean + half


def draw_region_heat(
    title: str, region_map: NDArray[np.integer], ious: Sequence[float], path: Path
) -> None:
    """Write a PNG: the regions coloured by their IoU, the IoU in each, a colour bar.

    Args:
        title: of the picture.
        region_map: (H, W), region of every pixel: 0..R-1.
        ious: R fractions; NaN regions stay white.
        path: of the PNG.
    """
    values = 100.0 * np.asarray(ious, np.float64)[region_map]
    height, width = values.shape
    low, high = colour_limits(ious)
    size = 9 if len(ious) <= 5 else 7  # nine rings are narrow
    figure = _figure(6.4, 5.4 * height / width + 0.5)
    axis = figure.subplots()
    shown = axis.imshow(values, cmap="viridis", vmin=low, vmax=high)
    axis.set(xticks=[], yticks=[])
    axis.set_title(title, fontsize=10, wrap=True)
    # Thin lines where the region changes, so that equal neighbours stay two regions.
    axis.contour(region_map, np.arange(0.5, len(ious)), colors="white", linewidths=0.6)
    for place, iou in zip(number_places(region_map, len(ious)), ious, strict=True):
        if place is not None:
            text = "-" if np.isnan(iou) else f"{100 * iou:.1f}"
            box = {"boxstyle": "round,pad=0.1", "facecolor": "white", "alpha": 0.8, "linewidth": 0}
            axis.text(place[1], place[0], text, ha="center", va="center", fontsize=size, bbox=box)
    figure.colorbar(shown, ax=axis, label="mIoU of the region, percent", shrink=0.85)
    with replacing(path) as file:
        figure.savefig(file, format="png")


def _figure(width_inches: float, height_inches: float) -> Figure:
    # Figures are made without pyplot: no global state, no display, nothing to close.
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width_inches, height_inches), dpi=110, layout="constrained")
    FigureCanvasAgg(figure)
    return figure
