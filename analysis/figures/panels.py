"""Pictures: qualitative panels, pairs of frames with predictions of both, and examples of masks.

None of the papers says how its images were chosen. Here they are named, or selected by a stated
rule.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import numpy as np
import pandas as pd
from annotated_types import Interval
from matplotlib import colormaps
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import NDArray

from analysis.arguments import MOST
from analysis.bar import progress
from analysis.figures import plots
from analysis.figures.inputs import (
    Config,
    Count,
    Drawn,
    Form,
    Layout,
    Names,
    Palette,
    Pick,
    Prefix,
    Rows,
    Scored,
    Split,
    Suffix,
    figure,
    labelled,
)
from analysis.predictions.scoring import ScoringOptions, score_folder
from rgbt.checks import InputError, nearest, split_list
from rgbt.config.options import Help
from rgbt.data.files import decode, read_rgb
from rgbt.data.mfnet import NextFrames
from rgbt.data.predictions import Affixes, FormatOptions, PredictionReader
from rgbt.metrics.counting import RegionCounter
from rgbt.metrics.counts import Counts, scored_classes
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

WHOLE = Regions(partition="ring", regions=1, aspect="image", absent="exclude")
"""The image as one region."""

OUTLINE, OUTLINED = "#FF2A2A", "predictions of both frames differ"
THERMAL_COLOURS = "jet"
"""Temporal, captions of Figs. 1 and 2."""

PATCHES = (8, 16, 32, 64)
"""Sides in pixels that the paper draws (CRM, Fig. 5 and Table 3b)."""

STRIDE = 32
"""Maskers cut images whose sides are multiples of this; others they would pad with black."""

HIDDEN = (150, 190, 230)
"""Colour of a hidden pixel: a grey one would be lost in a thermal image."""

Missing = Annotated[
    str, Help("predictions of these methods without this image (rgbt predict corruption=removed:)")
]
Exported = Annotated[str, Help("folder of pairs of frames that rgbt consistency export=... wrote")]
Patches = Annotated[tuple[Count, ...], Help("sides of the patches in pixels")]
Seed = Annotated[Annotated[int, Interval(ge=0, le=MOST)], Help("seed of the masks")]


class Folder(NamedTuple):
    """Predictions of a method: a label for the figure, and where they are."""

    label: str
    path: Path

    def read(self, reader: PredictionReader, name: str, image_hw: tuple[int, ...]) -> Bytes:
        """(H, W) class indices; InputError: no such file, or of another size than the image."""
        path = self.path / f"{reader.options.affixes.file_stem(name)}.png"
        if not path.is_file():
            raise InputError(f"methods: there is no prediction {path}.")
        found = reader.read(path)
        if found.shape != image_hw:
            sizes = ["x".join(map(str, shape)) for shape in (found.shape, image_hw)]
            raise InputError(f"methods: {path} is {sizes[0]} pixels but its image is {sizes[1]}.")
        return found


def folders(text: str) -> list[Folder]:
    """The methods of ``label:folder,label:folder``."""
    places = labelled(text, "methods").items()
    return [Folder(label, Path(place).expanduser()) for label, place in places]


@figure("spatialseg/fig8", "qualitative results", "dataset", "metric")
@figure("spatialseg/fig9", "qualitative results on another data set", "dataset", "metric")
@figure("crm/fig4", "qualitative results", "dataset", "metric")
def qualitative(
    config: Config,
    methods: Scored,
    names: Names = "",
    pick: Pick = "first",
    rows: Rows = 4,
    split: Split = "",
    layout: Layout = "rows",
    format: Form = "index",
    palette: Palette = "dataset",
    prefix: Prefix = "",
    suffix: Suffix = "",
) -> Drawn:
    """RGB, thermal, ground truth and predictions, with a white box on the centre."""
    form = FormatOptions(form=format, palette=palette, affixes=Affixes(prefix, suffix))
    every, dataset = folders(methods), config.dataset
    split = split or "test"
    if pick == "largest_difference" and not names:
        options = ScoringOptions(partitions=("ring",), regions=1, format=form)
        mious = {}
        with progress("comparing", len(every) * len(dataset.names(split))) as advance:
            for label, folder in every:
                (counts,) = score_folder(folder, dataset, split, options, advance).counts
                mious[label] = image_mious(counts)
        names = ",".join(most_different(mious, rows))
    shown = config.names(names, split, rows)
    made, cells, frame = panel(dataset, every, shown, form, layout)
    regions = config.regions
    if regions.aspect is None:
        raise InputError(f"metric: {regions.name} has no centre to put a box on; use rings.")
    height, width = dataset.read(shown[0]).thermal.shape
    box = ring_rectangle((height, width), regions.regions, 1, regions.aspect)
    corner = (box[1].start - 0.5, box[0].start - 0.5)
    size = (box[1].stop - box[1].start, box[0].stop - box[0].start)
    for axes in cells.flat:
        for colour, edge in (("black", 1.4), ("white", 0.8)):
            axes.add_patch(Rectangle(corner, *size, fill=False, edgecolor=colour, linewidth=edge))
    return made, frame


@figure("crm/fig2", "predictions with both images, without RGB and without thermal", "dataset")
def missing(
    config: Config,
    methods: Scored,
    without_rgb: Missing,
    without_thermal: Missing,
    names: Names = "",
    rows: Rows = 2,
    split: Split = "",
    layout: Layout = "rows",
    format: Form = "index",
    palette: Palette = "dataset",
    prefix: Prefix = "",
    suffix: Suffix = "",
) -> Drawn:
    """CRM, Fig. 2, with the mIoU of every prediction; InputError: methods differ."""
    form = FormatOptions(form=format, palette=palette, affixes=Affixes(prefix, suffix))
    three = {"both": methods, "no RGB": without_rgb, "no thermal": without_thermal}
    places = {kind: labelled(text, "methods") for kind, text in three.items()}
    if any(set(each) != set(places["both"]) for each in places.values()):
        raise InputError("methods: name the same ones in methods, without_rgb and without_thermal.")
    every = [
        Folder(f"{label}\n{kind}", Path(places[kind][label]).expanduser())
        for label in places["both"]
        for kind in three
    ]
    shown = config.names(names, split or "test", rows)
    made, cells, frame = panel(config.dataset, every, shown, form, layout)
    scores = frame["mIoU"].to_numpy().reshape(len(shown), -1)
    for axes, score in zip(cells[:, 3:].flat, scores.flat, strict=True):
        plots.in_corner(axes, f"{score:.1f}")
    return made, frame


def panel(
    dataset: LabelledDataset,
    every: Sequence[Folder],
    names: Sequence[str],
    form: FormatOptions,
    layout: str,
) -> tuple[Figure, NDArray[Any], pd.DataFrame]:
    """The pictures of a panel, one row per name.

    Returns:
        the figure; its axes; image, method and mIoU of this image alone, percent, over the scored
        classes that label or prediction hold, because a single image lacks most classes.

    Raises:
        InputError: images without label or that differ in size, or a prediction that is missing.
    """
    reader = PredictionReader(dataset.classes, dataset.palette, form)
    table, pictures, numbers = np.array(dataset.palette, np.uint8), [], []
    scored = scored_classes(dataset.classes, dataset.unscored)
    whole = RegionCounter(len(scored), WHOLE)
    for name in names:
        sample, label = labelled_sample(dataset, name)
        painted = [label]
        for folder in every:
            found = folder.read(reader, name, label.shape)
            score = 100 * miou(whole(label, found).sum(0), "exclude", scored)
            numbers.append((name, folder.label.replace("\n", " "), float(score)))
            painted.append(found)
        thermal = np.repeat(sample.thermal[..., None], 3, axis=2)
        pictures.append([sample.rgb, thermal, *(colours(each, table) for each in painted)])
    check_one_size([row[0].shape for row in pictures])
    titles = ["RGB", "thermal", "ground truth", *(folder.label for folder in every)]
    legend = plots.Legend(dataset.classes, table)
    made, cells = plots.picture_grid(pictures, names, titles, layout=layout, legend=legend)
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


def image_mious(counts: Counts) -> dict[str, float]:
    """Name -> mIoU of that image alone, percent, over the scored classes in it (else NaN)."""
    scores = 100 * miou(counts.counts.sum(1), "exclude", counts.scored)
    return dict(zip(counts.names, scores.tolist(), strict=True))


def most_different(scores: Mapping[str, Mapping[str, float]], number: int) -> tuple[str, ...]:
    """Names of the images where the last method differs most from the first.

    Args:
        scores: method -> name -> score of that image; images with a NaN are left out.
        number: how many.

    Returns:
        names by falling ``|last - first|``; equal ones in their order.

    Raises:
        InputError: fewer than two methods, or fewer images than requested.
    """
    if len(scores) < 2:
        raise InputError("pick=largest_difference compares two methods; give two in methods=...")
    first, *_, last = scores.values()
    gaps = {name: abs(last[name] - first[name]) for name in first}
    known = [name for name, gap in gaps.items() if not math.isnan(gap)]
    if len(known) < number:
        raise InputError(f"rows={number}, but there are only {len(known)} images to choose from.")
    return tuple(sorted(known, key=lambda name: -gaps[name])[:number])


class Frame(NamedTuple):
    """One frame with labels: (H, W, 3), (H, W) and (H, W) uint8; 255: no label."""

    rgb: Bytes
    thermal: Bytes
    label: Bytes


class FramePair(NamedTuple):
    """A pair of frames and the predictions of M methods.

    Attributes:
        name: of the first frame.
        frames: both.
        predictions: (H, W) class indices, of both frames, for each method.
        differ: (H, W) for each method, pixels of the second frame whose two predictions differ; of
            `compared` alone.
        compared: (H, W), pixels that count: seen in the first frame, labelled in the second.
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

    Args:
        config: chooses the data set and the virtual views.
        exported: folder that ``rgbt consistency export=...`` wrote.
        methods: predictions of both frames.
        form: of their files.
        view_set: number of the set of virtual views, from 1.

    Raises:
        InputError: an export of other images or views, or an unfinished one.
    """

    def __init__(
        self,
        config: Config,
        exported: str,
        methods: Sequence[Folder],
        form: FormatOptions,
        view_set: int = 1,
    ) -> None:
        self._folder, self._dataset, self.methods = (
            Path(exported).expanduser(),
            config.dataset,
            methods,
        )
        listed = read_list(self._folder)
        self._after = NextFrames(self._dataset) if listed.frames == "next" else None
        self._views: Any = None if self._after else config.built("consistency")
        self.second = "next frame" if self._after else "synthesised"
        made_of = self._after.dataset.fingerprint()[:6] if self._after else self._views.mark
        if not listed.complete:
            raise InputError(f"pairs: the export {exported} was interrupted; rerun its command.")
        if (listed.dataset, listed.views) != (self._dataset.fingerprint(), made_of or "published"):
            raise InputError(
                f"pairs: {exported} was exported from other images or other second frames "
                f"({listed.name}, {listed.views}); give the data set and the consistency settings "
                "of the export."
            )
        self.listed = {each.first: each for each in listed.pairs if each.set == view_set}
        if not self.listed:
            raise InputError(f"view_set={view_set}: the export has no such set of views.")
        self._reader = PredictionReader(self._dataset.classes, self._dataset.palette, form)

    def read(self, name: str) -> FramePair:
        """The pair whose first frame is called `name`."""
        pair = self.listed[name]
        sample, of_first = labelled_sample(self._dataset, name)
        label, (rows, columns), compared = self._follow(pair, of_first)
        rgb = read_rgb(self._folder / "rgb" / f"{pair.second}.png")
        thermal = np.asarray(decode(self._folder / "thermal" / f"{pair.second}.png"), np.uint8)
        predictions, differ = [], []
        for folder in self.methods:
            first = folder.read(self._reader, name, label.shape)
            second = folder.read(self._reader, pair.second, label.shape)
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
def pair_rows(
    config: Config,
    pairs: Exported,
    methods: Scored,
    view_set: Count = 1,
    names: Names = "",
    pick: Pick = "first",
    rows: Rows = 1,
    layout: Layout = "rows",
    format: Form = "index",
    palette: Palette = "dataset",
) -> Drawn:
    """Both frames, ground truth and predictions; pixels that lower TC are outlined."""
    form = FormatOptions(form=format, palette=palette)
    opened = Pairs(config, pairs, folders(methods), form, view_set)
    chosen = tuple(split_list(names, "names")) if names else tuple(opened.listed)[:rows]
    for name in chosen:
        if name not in opened.listed:
            near = nearest(name, [*opened.listed][:20])
            raise InputError(f"names: the export has no image '{name}'; {near}.")
    if not names and len(opened.listed) < rows:
        raise InputError(f"rows={rows}, but the export has {len(opened.listed)} pairs.")
    if pick == "largest_difference" and not names:
        shares = {name: opened.read(name).shares for name in opened.listed}
        by_method = {
            folder.label: {name: each[index] for name, each in shares.items()}
            for index, folder in enumerate(opened.methods)
        }
        chosen = most_different(by_method, rows)
    shown = [opened.read(name) for name in chosen]
    check_one_size([pair.compared.shape for pair in shown])
    labels, dataset = [folder.label for folder in opened.methods], config.dataset
    palette_ = np.array(dataset.palette, np.uint8)
    line = Line2D([], [], color=OUTLINE, linewidth=1.2, label=OUTLINED)
    legend = plots.Legend(dataset.classes, palette_, [line])
    rows_ = [
        (pair.name, label, share)
        for pair in shown
        for label, share in zip(labels, pair.shares, strict=True)
    ]
    frame = pd.DataFrame(rows_, columns=["image", "method", "differing_percent"])
    return draw_pairs(shown, labels, legend, opened.second, layout), frame


@figure("temporal/fig6", "four pairs of frames, two columns each", "dataset", "consistency")
def pair_columns(
    config: Config,
    pairs: Exported,
    methods: Scored,
    view_set: Count = 1,
    names: Names = "",
    pick: Pick = "first",
    rows: Rows = 4,
    layout: Layout = "columns",
    format: Form = "index",
    palette: Palette = "dataset",
) -> Drawn:
    """As `pair_rows`, with the number and the layout of the printed figure."""
    return pair_rows(config, pairs, methods, view_set, names, pick, rows, layout, format, palette)


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
            maps = [colours(each, legend.palette) for each in painted]
            pictures.append([frame.rgb, thermal, *maps])
        labels += [pair.name, second]
    titles = ("RGB", "thermal", "ground truth", *methods)
    made, cells = plots.picture_grid(pictures, labels, titles, layout=layout, legend=legend)
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
    names: Names = "",
    split: Split = "",
    patches: Patches = PATCHES,
    seed: Seed = 0,
) -> Drawn:
    """CRM, Fig. 5: RGB above, thermal below; what one image hides, the other shows."""
    sample = config.dataset.read(config.names(names, split or "test")[0])
    maskers = {
        title: config.built("masker", *words) for title, words in masker_overrides(patches).items()
    }
    examples = mask_examples(sample, maskers, math.lcm(STRIDE, *patches), seed)
    titles = [each.title for each in examples]
    pictures = [[each.rgb for each in examples], [each.thermal for each in examples]]
    made, _ = plots.picture_grid(pictures, ("RGB", "thermal"), titles)
    hidden = [(each.rgb_hidden.mean(), each.thermal_hidden.mean()) for each in examples]
    frame = pd.DataFrame(hidden, columns=["rgb_hidden", "thermal_hidden"])
    return made, frame.assign(mask=titles)[["mask", *frame.columns]]


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
    """The pair under each mask.

    The images are cut around their centre to whole cells: 64 pixels do not divide 480.

    Args:
        sample: a pair of the data set.
        maskers: by title.
        multiple: number of pixels that every cell divides.
        seed: every mask is drawn from it and its place among the maskers.

    Raises:
        InputError: the images are smaller than one cell.
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
        shown, hidden = [rgb.copy(), np.repeat(thermal[..., None], 3, axis=2)], []
        for image, cells in zip(shown, (pair.rgb[0].numpy(), pair.thermal[0].numpy()), strict=True):
            size = height // cells.shape[0], width // cells.shape[1]
            hidden.append(np.kron(cells, np.ones(size, bool)))
            image[hidden[-1]] = HIDDEN
        examples.append(MaskExample(title, *shown, *hidden))
    return tuple(examples)
