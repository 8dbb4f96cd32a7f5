"""A grid of pictures of one size with names, titles and a legend of classes.

Used by qualitative panels and by pairs of frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style

Picture = NDArray[Any]
Layout = Literal["rows", "columns"]

LINE = 0.14
"""Inches of a line of text."""

GAP = 0.08
"""Space between groups, in widths or heights of a picture."""


class Grid(NamedTuple):
    """A figure and its pictures.

    Attributes:
        cells: axes of every name and title, whatever the layout.
    """

    figure: Figure
    cells: tuple[tuple[Axes, ...], ...]


class Texts(NamedTuple):
    """What a grid of pictures says.

    Attributes:
        names: of what is shown, one per row ("rows") or column ("columns").
        titles: of the ways in which each is shown.
        classes: names of the legend.
        palette: (K, 3) uint8, their colours.
        more: further entries of the legend.
    """

    names: Sequence[str]
    titles: Sequence[str]
    classes: Sequence[str]
    palette: NDArray[np.uint8]
    more: Sequence[Artist] = ()


@style.styled
def draw_grid(
    pictures: Sequence[Sequence[Picture]], texts: Texts, layout: str, group: int = 0
) -> Grid:
    """Draw pictures across a page, with the legend below.

    Args:
        pictures: of every name, one per title, all of the same size: (H, W, 3) uint8.
        texts: names, titles and legend.
        layout: "rows": a row per name; "columns": a column per name.
        group: number of consecutive names that stay together, with a gap between groups; 0: none.
    """
    is_columns = layout == "columns"
    height, width = pictures[0][0].shape[:2]
    along = _places(len(texts.names), group)
    across = list(range(len(texts.titles)))
    lines, columns = (across, along) if is_columns else (along, across)
    above, beside = texts.names, texts.titles
    if not is_columns:
        above, beside = beside, above
    cell = (style.PAGE - 0.25) / _extent(columns)
    tall = cell * height / width
    above = [style.folded(text, cell) for text in above]
    beside = [style.folded(text, tall) for text in beside]
    top = 0.2 + LINE * max(text.count("\n") for text in above)
    legend = style.legend_height(style.PAGE, len(texts.classes) + len(texts.more))
    figure = style.new_figure(style.PAGE, _extent(lines) * (tall + 0.02) + top + legend)
    figure.set_layout_engine("compressed", w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    spec = figure.add_gridspec(
        lines[-1] + 1, columns[-1] + 1, height_ratios=_ratios(lines), width_ratios=_ratios(columns)
    )
    shown = [[figure.add_subplot(spec[line, column]) for column in columns] for line in lines]
    by_name = [list(each) for each in zip(*shown, strict=True)] if is_columns else shown
    for axes, row in zip(by_name, pictures, strict=True):
        for each, picture in zip(axes, row, strict=True):
            style.show_image(each, picture)
    for each, text in zip(shown[0], above, strict=True):
        each.set_title(text)
    for line, text in zip(shown, beside, strict=True):
        line[0].set_ylabel(text, fontsize=style.SMALL)
    style.class_legend(figure, texts.classes, texts.palette, texts.more)
    return Grid(figure, tuple(map(tuple, by_name)))


def _places(number: int, group: int) -> list[int]:
    """Position of each name among cells and gaps."""
    return [index + (index // group if group else 0) for index in range(number)]


def _ratios(places: Sequence[int]) -> list[float]:
    """Size of every cell and gap up to the last place."""
    return [1.0 if place in places else GAP for place in range(places[-1] + 1)]


def _extent(places: Sequence[int]) -> float:
    return sum(_ratios(places))
