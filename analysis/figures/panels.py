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
from rgbt.data.predictions import Affixes, FormatOptions, PredictionReader
from rgbt.metrics.counting import region_counts
from rgbt.metrics.counts import scored_classes
from rgbt.metrics.metric import Regions, ring_rectangle
from rgbt.metrics.pair_list import ListedPair, read_list
from rgbt.metrics.scores import miou
from rgbt.tracking.pictures import colours
from rgbt.types import IGNORE

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset
    from rgbt.types import AnyMasker, Sample

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

    @property
    def form(self) -> FormatOptions:
        """The format of the files."""
        affixes = Affixes(self.prefix, self.suffix)
        return FormatOptions(form=self.format, palette=self.palette, affixes=affixes)


@dataclass(frozen=True, kw_only=True)
class PairOptions(PictureOptions):
    """Pairs of frames."""

    pairs: Annotated[str, Help("folder that rgbt consistency export=... wrote")]
    view_set: Annotated[Count, Help("set of virtual views of these pairs, from 1")] = 1


def read_prediction(
    folder: Path, reader: PredictionReader, name: str, image_hw: tuple[int, ...]
) -> Bytes:
    """(H, W) class indices; InputError: no such file, or of another size than the image."""
    path = folder / f"{reader.options.affixes.file_stem(name)}.png"
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
    """RGB, thermal, ground truth and predictions, with a white box on the centre."""
    shown, regions = config.names(given.names, given.split, given.rows), config.regions
    if regions.aspect is None:
        raise InputError(f"metric: {regions.name} has no centre to put a box on; use rings.")
    folders = labelled(given.methods)
    made, cells, frame = panel(config.dataset, folders, shown, given.form, given.layout)
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
    """CRM, Fig. 2, with the mIoU of every prediction; InputError: methods differ."""
    three = {
        "both": labelled(given.methods),
        "no RGB": labelled(without_rgb),
        "no thermal": labelled(without_thermal),
    }
    if any(set(each) != set(three["both"]) for each in three.values()):
        raise InputError("methods: name the same ones in methods, without_rgb and without_thermal.")
    every = {f"{label}\n{kind}": three[kind][label] for label in three["both"] for kind in three}
    shown = config.names(given.names, given.split, rows)
    made, cells, frame = panel(config.dataset, every, shown, given.form, given.layout)
    for axes, score in zip(cells[:, 3:].flat, frame["mIoU"], strict=True):
        plots.in_corner(axes, f"{score:.1f}")
    return made, frame


def panel(
    dataset: LabelledDataset,
    folders: Mapping[str, Path],
    names: Sequence[str],
    form: FormatOptions,
    layout: str = "rows",
) -> tuple[Figure, NDArray[Any], pd.DataFrame]:
    """The pictures of a panel, one row per name: the figure, its axes, and the mIoU of each image.

    The mIoU is in percent, over the scored classes that label or prediction hold, because a single
    image lacks most classes. InputError: images without label or of several sizes, or a missing
    prediction.
    """
    reader = PredictionReader(dataset.classes, dataset.palette, form)
    palette, pictures, numbers = np.array(dataset.palette, np.uint8), [], []
    scored = scored_classes(dataset.classes, dataset.unscored)
    for name in names:
        sample, label = labelled_sample(dataset, name)
        painted = [label]
        for method, folder in folders.items():
            painted.append(read_prediction(folder, reader, name, label.shape))
            counts = region_counts(label, painted[-1], len(scored), WHOLE).sum(0)
            score = float(100 * miou(counts, "exclude", scored))
            numbers.append((name, method.replace("\n", " "), score))
        thermal = np.repeat(sample.thermal[..., None], 3, axis=2)
        pictures.append([sample.rgb, thermal, *(colours(each, palette) for each in painted)])
    check_one_size([row[0].shape for row in pictures])
    titles = ["RGB", "thermal", "ground truth", *folders]
    legend: plots.Legend = (dataset.classes, palette, ())
    made, cells = plots.picture_grid(pictures, names, titles, layout, legend)
    return made, cells, pd.DataFrame(numbers, columns=["image", "method", "mIoU"])


def labelled_sample(dataset: LabelledDataset, name: str) -> tuple[Sample, Bytes]:
    """A sample and its label; InputError where it has none."""
    sample = dataset.read(name)
    if sample.label is None:
        raise InputError(f"names: '{name}' has no label; choose images that are labelled.")
    return sample, sample.label


def check_one_size(sizes: Sequence[tuple[int, ...]]) -> None:
    """Refuse images of several sizes."""
    if len(set(sizes)) > 1:
        raise InputError(f"names: the images have different sizes {sorted(set(sizes))}.")


class Frame(NamedTuple):
    """One frame with labels: (H, W, 3), (H, W) and (H, W) uint8; 255: no label."""

    rgb: Bytes
    thermal: Bytes
    label: Bytes


class FramePair(NamedTuple):
    """A pair of frames and the predictions of M methods.

    All are (H, W): `compared` are pixels of the second frame that count, which are seen in the
    first one and labelled; `differ`, for each method, those whose two predictions differ.
    """

    name: str
    frames: tuple[Frame, Frame]
    predictions: tuple[tuple[Bytes, Bytes], ...]
    differ: tuple[Mask, ...]
    compared: Mask

    @property
    def shares(self) -> tuple[float, ...]:
        """Percent of the compared pixels that differ, for each method; NaN where none is."""
        count = int(self.compared.sum())
        return tuple(100 * int(each.sum()) / count if count else math.nan for each in self.differ)


class Pairs:
    """The pairs of an export, with the predictions of methods; pixels count as in TC.

    Raises:
        InputError: an export of other images or views, or an unfinished one.
    """

    def __init__(self, config: Config, given: PairOptions) -> None:
        self._folder, self._dataset = Path(given.pairs).expanduser(), config.dataset
        self.methods, listed = labelled(given.methods), read_list(self._folder)
        self._after = NextFrames(self._dataset) if listed.frames == "next" else None
        self.second, self._views = "synthesised", config.built("consistency")
        made_of = self._views.mark or "published"
        if self._after is not None:
            self.second, made_of = "next frame", self._after.dataset.fingerprint()[:6]
        if not listed.complete:
            raise InputError(f"pairs: the export {given.pairs} was interrupted; rerun its command.")
        if (listed.dataset, listed.views) != (self._dataset.fingerprint(), made_of):
            raise InputError(
                f"pairs: {given.pairs} was exported from other images or other second frames "
                f"({listed.name}, {listed.views}); give the data set and the consistency settings "
                "of the export."
            )
        self.listed = {each.first: each for each in listed.pairs if each.set == given.view_set}
        if not self.listed:
            raise InputError(f"view_set={given.view_set}: the export has no such set of views.")
        self._reader = PredictionReader(self._dataset.classes, self._dataset.palette, given.form)

    def read(self, name: str) -> FramePair:
        """The pair whose first frame is called `name`."""
        pair = self.listed[name]
        sample, of_first = labelled_sample(self._dataset, name)
        label, (rows, columns), compared = self._follow(pair, of_first)
        rgb = read_rgb(self._folder / "rgb" / f"{pair.second}.png")
        thermal = np.asarray(decode(self._folder / "thermal" / f"{pair.second}.png"), np.uint8)
        predictions, differ = [], []
        for folder in self.methods.values():
            first = read_prediction(folder, self._reader, name, label.shape)
            second = read_prediction(folder, self._reader, pair.second, label.shape)
            predictions.append((first, second))
            differ.append((first[rows, columns] != second) & compared)
        frames = Frame(sample.rgb, sample.thermal, of_first), Frame(rgb, thermal, label)
        return FramePair(name, frames, tuple(predictions), tuple(differ), compared)

    def _follow(
        self, pair: ListedPair, of_first: Bytes
    ) -> tuple[Bytes, tuple[NDArray[np.int64], NDArray[np.int64]], Mask]:
        """Label of the second frame, rows and columns of its pixels in the first, which count."""
        shape = of_first.shape
        if self._after:
            _, label = labelled_sample(self._after.dataset, pair.first)
            rows, columns = self._after.source(pair.first, (shape[0], shape[1]))
            return label, (rows.clip(0), columns.clip(0)), (rows >= 0) & (label != IGNORE)
        import torch

        view = self._views.view
        angles = torch.tensor([[pair.yaw, pair.pitch, pair.roll]], dtype=torch.float64)
        warp = view.warp(angles, shape)
        label = warp.nearest(torch.from_numpy(of_first)[None], view.outside_label)[0].numpy()
        places = torch.arange(label.size).view(1, *shape)
        rows, columns = np.divmod(warp.nearest(places, 0)[0].numpy(), shape[1])
        return label, (rows, columns), warp.inside()[0].numpy() & (label != IGNORE)


@figure("temporal/fig1", "a real frame and its synthesised next one", "dataset", "consistency")
def pair_rows(config: Config, given: PairOptions, *, rows: Rows = 1) -> Drawn:
    """Both frames, ground truth and predictions; pixels that lower TC are outlined."""
    opened = Pairs(config, given)
    methods = [*opened.methods]
    shown = [opened.read(name) for name in chosen_names(given.names, [*opened.listed], rows)]
    check_one_size([pair.compared.shape for pair in shown])
    palette = np.array(config.dataset.palette, np.uint8)
    line = Line2D([], [], color=OUTLINE, linewidth=1.2, label=OUTLINED)
    legend = config.dataset.classes, palette, [line]
    cells = [(p.name, *each) for p in shown for each in zip(methods, p.shares, strict=True)]
    frame = pd.DataFrame(cells, columns=["image", "method", "differing_percent"])
    return draw_pairs(shown, methods, legend, opened.second, given.layout), frame


@figure("temporal/fig6", "four pairs of frames, two columns each", "dataset", "consistency")
def pair_columns(config: Config, given: PairOptions, *, layout: Layout = "columns") -> Drawn:
    """The frames of `pair_rows` in the layout of the printed figure."""
    return pair_rows(config, replace(given, layout=layout), rows=given.rows)


@plots.styled
def draw_pairs(
    pairs: Sequence[FramePair],
    methods: Sequence[str],
    legend: plots.Legend,
    second: str,
    layout: str,
) -> Figure:
    """Pictures of both frames of every pair; below them the classes; `second`: what they are."""
    pictures, labels = [], []
    for pair in pairs:
        # Both frames of a pair share the limits, so that a colour means the same in both.
        low, high = int(pair.frames[0].thermal.min()), int(pair.frames[0].thermal.max())
        for index, frame in enumerate(pair.frames):
            painted = [frame.label, *(both[index] for both in pair.predictions)]
            relative = ((frame.thermal.astype(float) - low) / max(high - low, 1)).clip(0, 1)
            thermal = (255 * colormaps[THERMAL_COLOURS](relative)[..., :3]).astype(np.uint8)
            maps = [colours(each, legend[1]) for each in painted]
            pictures.append([frame.rgb, thermal, *maps])
        labels += [pair.name, second]
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


class MaskExample(NamedTuple):
    """One mask on a pair of images: (H, W, 3) pictures with hidden pixels in the colour `HIDDEN`,
    and (H, W) which pixels are hidden.
    """

    title: str
    rgb: Bytes
    thermal: Bytes
    rgb_hidden: Mask
    thermal_hidden: Mask


@figure("crm/fig5", "masks on a pair of images: a square, and patches of four sizes", "dataset")
def masks(
    config: Config,
    *,
    names: Names = "",
    split: Split = "",
    seed: Annotated[int, Interval(ge=0, le=MOST), Help("seed of the masks")] = 0,
) -> Drawn:
    """CRM, Fig. 5: RGB above, thermal below; what one image hides, the other shows."""
    sample = config.dataset.read(config.names(names, split)[0])
    chosen = masker_overrides(PATCHES).items()
    maskers = {title: config.built("masker", *words) for title, words in chosen}
    examples = mask_examples(sample, maskers, math.lcm(STRIDE, *PATCHES), seed)
    pictures = [[each.rgb for each in examples], [each.thermal for each in examples]]
    made, _ = plots.picture_grid(pictures, ("RGB", "thermal"), [*maskers])
    rows = [(e.title, e.rgb_hidden.mean(), e.thermal_hidden.mean()) for e in examples]
    return made, pd.DataFrame(rows, columns=["mask", "rgb_hidden", "thermal_hidden"])


def masker_overrides(patches: Sequence[int]) -> dict[str, tuple[str, ...]]:
    """Title -> what chooses the masker of each column of Fig. 5: a square, then the patches."""
    by_size = {
        f"{size} x {size} pixels": ("masker=crm", f"masker.patch_size={size}") for size in patches
    }
    every = {"square": ("masker=square",), **by_size}
    return {title: (*words, "masker.pairing=comp") for title, words in every.items()}


def mask_examples(
    sample: Sample, maskers: Mapping[str, AnyMasker], multiple: int, seed: int
) -> tuple[MaskExample, ...]:
    """The pair under each mask, cut around its centre to whole cells: 64 does not divide 480.

    Every cell divides `multiple` pixels; a mask is drawn from the seed and its place among the
    maskers. InputError: the images are smaller than one cell.
    """
    import torch

    from rgbt.randomness import torch_generator

    full = sample.thermal.shape
    height, width = (length // multiple * multiple for length in full)
    if min(height, width) == 0:
        raise InputError(f"patches: '{sample.name}' has {full} pixels, less than {multiple}.")
    top, left = (full[0] - height) // 2, (full[1] - width) // 2
    rgb, thermal = (
        image[top : top + height, left : left + width] for image in (sample.rgb, sample.thermal)
    )
    centre = torch.tensor([[height // 2, width // 2]])
    examples = []
    for index, (title, masker) in enumerate(maskers.items()):
        pair = masker((height, width), centre, torch_generator(seed, "figure masks", index))
        shown = [rgb.copy(), np.repeat(thermal[..., None], 3, axis=2)]
        hidden: list[Mask] = []
        for image, cells in zip(shown, (pair.rgb[0].numpy(), pair.thermal[0].numpy()), strict=True):
            size = height // cells.shape[0], width // cells.shape[1]
            hidden.append(np.kron(cells, np.ones(size, bool)))
            image[hidden[-1]] = HIDDEN
        examples.append(MaskExample(title, shown[0], shown[1], hidden[0], hidden[1]))
    return tuple(examples)
