"""Pictures: qualitative panels, pairs of frames with predictions of both, and examples of masks.

None of the papers says how its images were chosen. Here they are named, or the first ones.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
import pandas as pd
from annotated_types import Interval
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from analysis.commands import MOST
from analysis.figures import plots
from analysis.figures.inputs import (
    Config,
    Count,
    Drawn,
    Methods,
    Names,
    Split,
    chosen_names,
    figure,
    labelled,
)
from rgbt.checks import InputError
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.config.options import Help
from rgbt.data.files import decode, read_rgb
from rgbt.data.mfnet import NextFrames
from rgbt.data.predictions import PredictionReader
from rgbt.metrics.counting import region_counts
from rgbt.metrics.counts import scored_classes
from rgbt.metrics.metric import Regions, ring_rectangle
from rgbt.metrics.pair_list import ListedPair, read_list
from rgbt.metrics.scores import miou, tally
from rgbt.tracking.pictures import colours
from rgbt.types import IGNORE, Sample

if TYPE_CHECKING:
    import torch

    from rgbt.dataset import LabelledDataset
    from rgbt.types import AnyMasker

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

# The image as one region.
WHOLE = Regions(partition="ring", regions=1, aspect="image", absent="exclude")

OUTLINE, OUTLINED = "#FF2A2A", "predictions of both frames differ"
# Temporal, captions of Figs. 1 and 2.
THERMAL_COLOURS = "jet"

# Sides in pixels that the paper draws (CRM, Fig. 5 and Table 3b).
PATCHES = (8, 16, 32, 64)

# Maskers cut images whose sides are multiples of this; others they would pad with black.
STRIDE = 32

# Colour of a hidden pixel: a grey one would be lost in a thermal image.
HIDDEN = (150, 190, 230)


Rows = Annotated[Count, Help("number of images")]
PairFolder = Annotated[str, Help("folder that rgbt consistency export=... wrote")]
ViewSet = Annotated[Count, Help("set of virtual views of these pairs, from 1")]
Layout = Annotated[
    Literal["rows", "columns"], Help("one row or one column per image: rows or columns")
]


@dataclass(frozen=True, kw_only=True)
class PictureOptions(PredictionFormatOptions):
    """Images and predictions of methods."""

    methods: Methods
    names: Names = ""
    rows: Rows = 4
    split: Split = ""
    layout: Layout = "rows"


def read_prediction(
    folder: Path, reader: PredictionReader, name: str, image_hw: tuple[int, ...]
) -> Bytes:
    """Read (H, W) class indices; InputError: no such file, or of another size than the image."""
    path = reader.path(folder, name)
    if not path.is_file():
        raise InputError(f"methods: there is no prediction {path}.")
    found = reader.read(path)
    if found.shape != image_hw:
        sizes = ["x".join(map(str, shape)) for shape in (found.shape, image_hw)]
        raise InputError(f"methods: {path} is {sizes[0]} pixels but its image is {sizes[1]}.")
    return found


@figure("spatialseg/fig8", "qualitative results", "dataset", "metric")
@figure("spatialseg/fig9", "qualitative results on another data set", "dataset", "metric")
@figure("crm/fig4", "qualitative results", "dataset", "metric")
def qualitative(config: Config, given: PictureOptions) -> Drawn:
    """Show RGB, thermal, ground truth and predictions, with a white box on the centre."""
    shown, regions = config.names(given.names, given.split, given.rows), config.regions
    if regions.aspect is None:
        raise InputError(f"metric: {regions.name} has no centre to put a box on; use rings.")
    folders = labelled(given.methods)
    made, cells, frame = panel(config.dataset, folders, shown, given, given.layout)
    height, width = cells[0, 0].images[0].get_array().shape[:2]
    rows, columns = ring_rectangle((height, width), regions.regions, 1, regions.aspect)
    corner = (columns.start - 0.5, rows.start - 0.5)
    size = (columns.stop - columns.start, rows.stop - rows.start)
    for axes in cells.flat:
        for colour, edge in (("black", 1.4), ("white", 0.8)):
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=edge))
    return made, frame


@figure("crm/fig2", "predictions with both images, without RGB and without thermal", "dataset")
def missing(
    config: Config,
    given: PictureOptions,
    *,
    without_rgb: Annotated[
        str, Help("predictions of these methods by rgbt predict corruption=removed:rgb")
    ],
    without_thermal: Annotated[str, Help("the same with corruption=removed:thermal")],
    rows: Rows = 2,
) -> Drawn:
    """Show CRM, Fig. 2, with the mIoU of every prediction; InputError: methods differ."""
    three = {
        "both": labelled(given.methods),
        "no RGB": labelled(without_rgb),
        "no thermal": labelled(without_thermal),
    }
    if any(set(folders) != set(three["both"]) for folders in three.values()):
        raise InputError("methods: name the same ones in methods, without_rgb and without_thermal.")
    every = {}
    for label in three["both"]:
        for kind, folders in three.items():
            every[f"{label}\n{kind}"] = folders[label]
    shown = config.names(given.names, given.split, rows)
    made, cells, frame = panel(config.dataset, every, shown, given, given.layout)
    for axes, score in zip(cells[:, 3:].flat, frame["mIoU"], strict=True):
        plots.in_corner(axes, f"{score:.1f}")
    return made, frame


def panel(
    dataset: LabelledDataset,
    folders: Mapping[str, Path],
    names: Sequence[str],
    given: PredictionFormatOptions,
    layout: str = "rows",
) -> tuple[Figure, NDArray[Any], pd.DataFrame]:
    """Draw the pictures of a panel, a row per name; return the figure, its axes, and the mIoU.

    The mIoU of each image is in percent, over the scored classes that label or prediction hold,
    because a single image lacks most classes. InputError: images without label or of several sizes,
    or a missing prediction.
    """
    reader = PredictionReader(dataset.classes, dataset.palette, *given.form)
    palette, pictures, numbers = np.array(dataset.palette, np.uint8), [], []
    scored = scored_classes(dataset.classes, dataset.unscored)
    for name in names:
        sample, label = labelled_sample(dataset, name)
        painted = [label]
        for method, folder in folders.items():
            painted.append(read_prediction(folder, reader, name, label.shape))
            counts = region_counts(label, painted[-1], len(scored), WHOLE).sum(0)
            score = float(100 * miou(tally(counts), "exclude", scored))
            numbers.append((name, method.replace("\n", " "), score))
        thermal = np.repeat(sample.thermal[..., None], 3, axis=2)
        pictures.append([sample.rgb, thermal, *(colours(classes, palette) for classes in painted)])
    check_one_size([row[0].shape for row in pictures])
    titles = ["RGB", "thermal", "ground truth", *folders]
    legend: plots.Legend = (dataset.classes, palette, ())
    made, cells = plots.picture_grid(pictures, names, titles, layout, legend)
    return made, cells, pd.DataFrame(numbers, columns=["image", "method", "mIoU"])


def labelled_sample(dataset: LabelledDataset, name: str) -> tuple[Sample, Bytes]:
    """Read a sample and its label; InputError where it has none."""
    sample = dataset.read(name)
    if sample.label is None:
        raise InputError(f"names: '{name}' has no label; choose images that are labelled.")
    return sample, sample.label


def check_one_size(sizes: Sequence[tuple[int, ...]]) -> None:
    """Refuse images of several sizes."""
    if len(set(sizes)) > 1:
        raise InputError(f"names: the images have different sizes {sorted(set(sizes))}.")


class FramePair(NamedTuple):
    """A pair of labelled frames and the predictions of M methods.

    The masks are (H, W): `compared` are pixels of the second frame that count, which are seen in
    the first one and labelled; `differ`, for each method, those whose two predictions differ.
    """

    first: Sample
    second: Sample
    predictions: tuple[tuple[Bytes, Bytes], ...]
    differ: tuple[Mask, ...]
    compared: Mask

    @property
    def shares(self) -> tuple[float, ...]:
        """Percent of the compared pixels that differ, for each method; NaN where none is."""
        count = int(self.compared.sum())
        if count == 0:
            return (math.nan,) * len(self.differ)
        return tuple(100 * int(mask.sum()) / count for mask in self.differ)


def read_pairs(
    config: Config, given: PictureOptions, pairs: str, view_set: int
) -> tuple[list[FramePair], str]:
    """Read the chosen pairs of an export with the predictions of methods; pixels count as in TC.

    Returns also what the second frames are: "synthesised" or "next frame". InputError: an export
    of other images or views, or an unfinished one.
    """
    folder, dataset = Path(pairs).expanduser(), config.dataset
    methods, listed = labelled(given.methods), read_list(folder)
    views, following = config.built("consistency"), None
    what, made_of = "synthesised", views.mark or "published"
    if listed.frames == "next":
        following = NextFrames(dataset)
        what, made_of = "next frame", following.dataset.fingerprint()[:6]
    if not listed.complete:
        raise InputError(f"pairs: the export {pairs} was interrupted; rerun its command.")
    if (listed.dataset, listed.views) != (dataset.fingerprint(), made_of):
        raise InputError(
            f"pairs: {pairs} was exported from other images or other second frames "
            f"({listed.name}, {listed.views}); give the data set and the consistency settings "
            "of the export."
        )
    of_set = {pair.first: pair for pair in listed.pairs if pair.set == view_set}
    if not of_set:
        raise InputError(f"view_set={view_set}: the export has no such set of views.")
    reader, found = PredictionReader(dataset.classes, dataset.palette, *given.form), []
    for name in chosen_names(given.names, [*of_set], given.rows):
        pair = of_set[name]
        first, of_first = labelled_sample(dataset, name)
        if following is None:
            label, source, compared = _seen_in_view(views.view, pair, of_first)
        else:
            label, source, compared = _seen_next(following, pair, of_first)
        rgb = read_rgb(folder / "rgb" / f"{pair.second}.png")
        thermal = np.asarray(decode(folder / "thermal" / f"{pair.second}.png"), np.uint8)
        predictions, differ = [], []
        for of_method in methods.values():
            earlier = read_prediction(of_method, reader, name, label.shape)
            later = read_prediction(of_method, reader, pair.second, label.shape)
            predictions.append((earlier, later))
            differ.append((earlier[source] != later) & compared)
        second = Sample(rgb=rgb, thermal=thermal, label=label, name=pair.second)
        found.append(FramePair(first, second, tuple(predictions), tuple(differ), compared))
    return found, what


# Label of the second frame, rows and columns of its pixels in the first, and which of them count.
Seen = tuple[Bytes, tuple[NDArray[np.int64], NDArray[np.int64]], Mask]


def _seen_next(following: NextFrames, pair: ListedPair, of_first: Bytes) -> Seen:
    shape = of_first.shape
    _, label = labelled_sample(following.dataset, pair.first)
    rows, columns = following.source(pair.first, (shape[0], shape[1]))
    return label, (rows.clip(0), columns.clip(0)), (rows >= 0) & (label != IGNORE)


def _seen_in_view(view: Any, pair: ListedPair, of_first: Bytes) -> Seen:
    import torch

    angles = torch.tensor([[pair.yaw, pair.pitch, pair.roll]], dtype=torch.float64)
    warp = view.warp(angles, of_first.shape)
    label = warp.nearest(torch.from_numpy(of_first)[None], view.outside_label)[0].numpy()
    places = torch.arange(label.size).view(1, *of_first.shape)
    rows, columns = np.divmod(warp.nearest(places, 0)[0].numpy(), of_first.shape[1])
    return label, (rows, columns), warp.inside()[0].numpy() & (label != IGNORE)


@figure("temporal/fig1", "a real frame and its synthesised next one", "dataset", "consistency")
def pair_rows(
    config: Config,
    given: PictureOptions,
    *,
    pairs: PairFolder,
    view_set: ViewSet = 1,
    rows: Rows = 1,
) -> Drawn:
    """Show both frames, ground truth and predictions; pixels that lower TC are outlined."""
    shown, second = read_pairs(config, replace(given, rows=rows), pairs, view_set)
    check_one_size([pair.compared.shape for pair in shown])
    methods = [*labelled(given.methods)]
    line = Line2D([], [], color=OUTLINE, linewidth=1.2, label=OUTLINED)
    legend = config.dataset.classes, np.array(config.dataset.palette, np.uint8), [line]
    numbers = []
    for pair in shown:
        for method, share in zip(methods, pair.shares, strict=True):
            numbers.append((pair.first.name, method, share))
    frame = pd.DataFrame(numbers, columns=["image", "method", "differing_percent"])
    return draw_pairs(shown, methods, legend, second, given.layout), frame


@figure("temporal/fig6", "four pairs of frames, two columns each", "dataset", "consistency")
def pair_columns(
    config: Config,
    given: PictureOptions,
    *,
    pairs: PairFolder,
    view_set: ViewSet = 1,
    layout: Layout = "columns",
) -> Drawn:
    """Show the frames of `pair_rows` in the layout of the printed figure."""
    given = replace(given, layout=layout)
    return pair_rows(config, given, pairs=pairs, view_set=view_set, rows=given.rows)


@plots.styled
def draw_pairs(
    pairs: Sequence[FramePair],
    methods: Sequence[str],
    legend: plots.Legend,
    second: str,
    layout: str,
) -> Figure:
    """Draw both frames of every pair, and the classes below; `second`: what second frames are."""
    pictures, labels = [], []
    for pair in pairs:
        # Both frames of a pair share the limits, so that a colour means the same in both.
        low, high = int(pair.first.thermal.min()), int(pair.first.thermal.max())
        for index, sample in enumerate((pair.first, pair.second)):
            assert sample.label is not None, "pairs are labelled"
            painted = [sample.label, *(both[index] for both in pair.predictions)]
            relative = ((sample.thermal.astype(float) - low) / max(high - low, 1)).clip(0, 1)
            thermal = (255 * colormaps[THERMAL_COLOURS](relative)[..., :3]).astype(np.uint8)
            maps = [colours(classes, legend[1]) for classes in painted]
            pictures.append([sample.rgb, thermal, *maps])
        labels += [pair.first.name, second]
    titles = ("RGB", "thermal", "ground truth", *methods)
    made, cells = plots.picture_grid(pictures, labels, titles, layout, legend)
    for pair, of_pair in zip(pairs, cells[1::2], strict=True):
        for axes, differ, share in zip(of_pair[3:], pair.differ, pair.shares, strict=True):
            if differ.any():
                # A border of False closes the lines at the edge of the picture.
                padded, (height, width) = np.pad(differ, 1).astype(float), differ.shape
                at = np.arange(-1, width + 1), np.arange(-1, height + 1)
                axes.contour(*at, padded, levels=[0.5], colors=OUTLINE, linewidths=0.5)
                axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
            plots.in_corner(axes, "-" if math.isnan(share) else f"{share:.1f} %")
    return made


@figure("crm/fig5", "masks on a pair of images: a square, and patches of four sizes", "dataset")
def masks(
    config: Config,
    *,
    names: Names = "",
    split: Split = "",
    seed: Annotated[int, Interval(ge=0, le=MOST), Help("seed of the masks")] = 0,
) -> Drawn:
    """Show CRM, Fig. 5: RGB above, thermal below; what one image hides, the other shows."""
    from rgbt.randomness import torch_generator

    sample = config.dataset.read(config.names(names, split)[0])
    chosen, multiple = masker_overrides(PATCHES), math.lcm(STRIDE, *PATCHES)
    above, below, rows = [], [], []
    for index, (title, words) in enumerate(chosen.items()):
        generator = torch_generator(seed, "figure masks", index)
        masker = config.built("masker", *words)
        (rgb, thermal), hidden = under_mask(sample, masker, multiple, generator)
        above.append(rgb)
        below.append(thermal)
        rows.append((title, hidden[0].mean(), hidden[1].mean()))
    made, _ = plots.picture_grid([above, below], ("RGB", "thermal"), [*chosen])
    return made, pd.DataFrame(rows, columns=["mask", "rgb_hidden", "thermal_hidden"])


def masker_overrides(patches: Sequence[int]) -> dict[str, tuple[str, ...]]:
    """Return what chooses the masker of each column of Fig. 5, by title: a square, then patches."""
    chosen: dict[str, tuple[str, ...]] = {"square": ("masker=square",)}
    for size in patches:
        chosen[f"{size} x {size} pixels"] = ("masker=crm", f"masker.patch_size={size}")
    return {title: (*words, "masker.pairing=comp") for title, words in chosen.items()}


def under_mask(
    sample: Sample, masker: AnyMasker, multiple: int, generator: torch.Generator
) -> tuple[Bytes, Mask]:
    """Hide what a mask hides of RGB and of thermal, cut around the centre to whole cells.

    Every cell divides `multiple` pixels; the centre is cut out because 64 does not divide 480.
    Returns pictures (2, H, W, 3) with hidden pixels in the colour `HIDDEN`, and which pixels are
    hidden (2, H, W). InputError: the images are smaller than one cell.
    """
    import torch

    full = sample.thermal.shape
    height, width = (length // multiple * multiple for length in full)
    if min(height, width) == 0:
        raise InputError(f"patches: '{sample.name}' has {full} pixels, less than {multiple}.")
    top, left = (full[0] - height) // 2, (full[1] - width) // 2
    thermal = np.repeat(sample.thermal[..., None], 3, axis=2)
    pictures = np.stack([sample.rgb, thermal])[:, top : top + height, left : left + width]
    mask = masker((height, width), torch.tensor([[height // 2, width // 2]]), generator)
    hidden = np.zeros((2, height, width), bool)
    for index, cells in enumerate((mask.rgb[0].numpy(), mask.thermal[0].numpy())):
        size = height // cells.shape[0], width // cells.shape[1]
        hidden[index] = np.kron(cells, np.ones(size, bool))
    pictures[hidden] = HIDDEN
    return pictures, hidden
