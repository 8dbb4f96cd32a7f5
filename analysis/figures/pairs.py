"""Pairs of frames: a real frame beside its synthesised next one, and what methods predict of both.

Temporal, Fig. 1 (one pair, a row per frame) and Fig. 6 (four pairs, two columns each). Pixels of
the second frame where the two predictions of a method differ are outlined: those that lower TC.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from analysis.figures import style
from analysis.figures.frame_pairs import Bytes, FramePair, Mask, Pairs
from analysis.figures.grid import Texts, draw_grid
from analysis.figures.inputs import FigureInput
from analysis.figures.panels import most_different
from rgbt.checks import InputError, nearest
from rgbt.terminal import info
from rgbt.tracking.pictures import colours

THERMAL_COLOURS = "jet"
"""Temporal, captions of Figs. 1 and 2."""

OUTLINE = "#FF2A2A"
OUTLINED = "predictions of both frames differ"

NUMBER = {"temporal/fig1": 1, "temporal/fig6": 4}
LAYOUT = {"temporal/fig1": "rows", "temporal/fig6": "columns"}
"""Pairs and layout of the printed figures."""


def make(given: FigureInput) -> Figure:
    """Both frames, ground truth and predictions of pairs."""
    pairs = Pairs(given)
    shown = [pairs.read(name) for name in _chosen(given, pairs)]
    sizes = {pair.compared.shape for pair in shown}
    if len(sizes) > 1:
        raise InputError(f"names: the images have different sizes {sorted(sizes)}; show one size.")
    for pair in shown:
        shares = zip(pairs.methods, pair.shares, strict=True)
        said = ", ".join(f"{label} {share:.2f} %" for label, share in shares)
        info(f"{pair.name}: {OUTLINED} in {said}")
    layout = given.get("layout", LAYOUT[given.figure])
    dataset = given.dataset
    palette = np.array(dataset.palette, np.uint8)
    return draw(
        shown, tuple(pairs.methods), (tuple(dataset.classes), palette), pairs.second, layout
    )


def _chosen(given: FigureInput, pairs: Pairs) -> tuple[str, ...]:
    """Names of the first frames, by ``names=`` or ``pick=`` and ``rows=``."""
    number = given.get("rows", NUMBER[given.figure])
    if "names" in given.values:
        if "pick" in given.values or "rows" in given.values:
            raise InputError("names= selects the images; omit pick= and rows=.")
        names = tuple(name.strip() for name in str(given.values["names"]).split(","))
        for name in names:
            if name not in pairs.listed:
                near = nearest(name, list(pairs.listed)[:20])
                raise InputError(f"names: the export has no image '{name}'; {near}.")
        return names
    if len(pairs.listed) < number:
        raise InputError(f"rows={number}, but the export has {len(pairs.listed)} pairs.")
    if given.get("pick", "first") == "first":
        return tuple(pairs.listed)[:number]
    every = {name: pairs.read(name).shares for name in pairs.listed}
    shares: Mapping[str, Mapping[str, float]] = {
        label: {name: each[index] for name, each in every.items()}
        for index, label in enumerate(pairs.methods)
    }
    return most_different(shares, tuple(pairs.listed), number)


@style.styled
def draw(
    pairs: list[FramePair],
    methods: tuple[str, ...],
    classes: tuple[tuple[str, ...], Bytes],
    second: str,
    layout: str,
) -> Figure:
    """Pictures of both frames of every pair; below them the classes.

    Args:
        pairs: of one size.
        methods: labels.
        classes: names and palette.
        second: what second frames are called.
        layout: "columns": two columns per pair; "rows": two rows.
    """
    names, palette = classes
    pictures, labels = [], []
    for pair in pairs:
        limits = int(pair.frames[0].thermal.min()), int(pair.frames[0].thermal.max())
        for index, frame in enumerate(pair.frames):
            painted = [frame.label, *(both[index] for both in pair.predictions)]
            thermal = coloured(frame.thermal, limits)
            pictures.append((frame.rgb, thermal, *(colours(each, palette) for each in painted)))
        labels += [pair.name, second]
    titles = ("RGB", "thermal", "ground truth", *methods)
    mark = Line2D([], [], color=OUTLINE, linewidth=1.2, label=OUTLINED)
    grid = draw_grid(pictures, Texts(labels, titles, names, palette, (mark,)), layout, group=2)
    for pair, cells in zip(pairs, grid.cells[1::2], strict=True):
        for axes, differ, share in zip(cells[3:], pair.differ, pair.shares, strict=True):
            _outline(axes, differ, share)
    return grid.figure


def coloured(thermal: Bytes, limits: tuple[int, int]) -> Bytes:
    """(H, W, 3) uint8: grey levels (H, W) in the colours of the paper, from `limits` stretched.

    Both frames of a pair share the limits, so that a colour means the same in both.
    """
    from matplotlib import colormaps

    low, high = limits
    relative = (thermal.astype(float) - low) / max(high - low, 1)
    return np.asarray(255 * colormaps[THERMAL_COLOURS](relative.clip(0, 1))[..., :3]).astype(
        np.uint8
    )


def _outline(axes: Axes, differ: Mask, share: float) -> None:
    """A line around the pixels that differ, and their share in the corner."""
    if differ.any():
        # A border of False closes the lines at the edge of the picture.
        padded = np.pad(differ, 1).astype(float)
        height, width = differ.shape
        at = np.arange(-1, width + 1), np.arange(-1, height + 1)
        axes.contour(*at, padded, levels=[0.5], colors=OUTLINE, linewidths=0.5)
        axes.set_xlim(-0.5, width - 0.5)
        axes.set_ylim(height - 0.5, -0.5)
    style.in_corner(axes, "-" if np.isnan(share) else f"{share:.1f} %")
