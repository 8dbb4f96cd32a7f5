"""The plots of all figures: lines, points and heat maps of tidy frames, and grids of pictures.

Figures are drawn without pyplot (no display, no global state). `styled` sets the letters and lines
of ``paper.mplstyle`` while something is drawn; `save` keeps text as text in PDF and SVG.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib import rc_context, rc_params_from_file
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from numpy.typing import NDArray

from analysis.commands import check_out
from rgbt.checks import InputError
from rgbt.files.atomic import write_atomic
from rgbt.tracking.pictures import number_places

# Width in inches of one column and of a page of two columns (IEEE).
COLUMN, PAGE = 3.4, 7.0

# Points of numbers on small pictures, and of ticks, legends and other small letters.
TINY, SMALL = 5.0, 7.0

# Average number of letters in an inch of a label or a title.
LETTERS_PER_INCH = 17

# Letters whose room the line and the gap of a legend's entry take.
HANDLE_LETTERS = 7

# Inches that a class takes in a legend.
LEGEND_ENTRY = 0.72

# Inches of a line of text, and of a small digit.
LINE, DIGIT = 0.14, 0.06

SUFFIXES = (".pdf", ".svg", ".png")

# Okabe and Ito's, the strong ones first; grey and olive (Tol) instead of their yellow, which is
# lost as a thin line on white, and of black, which stands for what is set apart.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#777777", "#999933")

APART = "black"
HATCHES = ("", "////", "....", "xxxx")
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
LINES = ("-", "--", "-.", ":")

# Decorator: draw with the letters, lines and sizes of the style sheet.
styled = rc_context(
    rc_params_from_file(Path(__file__).with_name("paper.mplstyle"), use_default_template=False)
)


def new_figure(width: float, height: float) -> Figure:
    """Make an empty figure of `width` x `height` inches that makes room for its labels."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def out_path(out: str) -> Path:
    """Return the file that ``out=`` names; InputError: another ending, or it cannot be written."""
    path = Path(out).expanduser()
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(f"out={out}: expected a name that ends in {', '.join(SUFFIXES)}.")
    check_out(path.parent)
    return path


def save(figure: Figure, path: Path) -> None:
    """Write `figure` at its size: PDF and SVG with text as text, PNG at 300 dots per inch."""
    content = content_of(figure, out_path(str(path)).suffix.lower()[1:])
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content)


@styled
def content_of(figure: Figure, kind: str) -> bytes:
    """Return the bytes of a file of `figure`: "pdf", "svg" or "png"."""
    # Without the time of day the same data gives the same file.
    dated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}[kind]
    content = io.BytesIO()
    figure.savefig(content, format=kind, metadata=dated)
    return content.getvalue()


def series_style(index: int) -> dict[str, Any]:
    """Return colour, marker and line of a series; no two of the first 32 agree in all three."""
    turn, place = divmod(index, len(COLOURS))
    return {
        "color": COLOURS[place],
        "marker": MARKERS[(place + turn) % len(MARKERS)],
        "linestyle": LINES[(index + turn) % len(LINES)],
    }


def line_plot(
    axes: Axes,
    frame: pd.DataFrame,
    styles: Mapping[str, dict[str, Any]] | None = None,
    *,
    bars: bool = False,
    spread: float = 0.0,
) -> None:
    """Draw a line for each series of (series, x, value, low, high), with its known intervals.

    `styles` differ from `series_style`. Intervals are bars or bands; `spread`: series stand side
    by side over this part of x, so that no bars overlap.
    """
    groups = [*frame.groupby("series", sort=False)]
    for index, (name, rows) in enumerate(groups):
        how = {**series_style(index), "label": str(name), **(styles or {}).get(str(name), {})}
        x = rows["x"] + spread * (index / max(1, len(groups) - 1) - 0.5)
        value, low, high = rows["value"], rows["low"], rows["high"]
        if bars:
            # A rounding error may put a value outside its interval; no bar is negative.
            lengths = np.maximum([value - low, high - value], 0) if low.notna().any() else None
            axes.errorbar(x, value, lengths, **{"elinewidth": 0.7, **how})
            continue
        axes.plot(x, value, **how)
        if low.notna().any():
            axes.fill_between(x, low, high, color=how["color"], alpha=0.15, linewidth=0.5)


def dot_plot(axes: Axes, frame: pd.DataFrame, *, open_low: bool = False) -> None:
    """Draw points over words, of (series, tick, value, low, high), with a bar between known ends.

    Series stand side by side; with `open_low` the low end has an open marker.
    """
    ticks, series = [*dict.fromkeys(frame["tick"])], [*dict.fromkeys(frame["series"])]
    step = min(0.15, 0.7 / len(series))
    for index, name in enumerate(series):
        rows = frame[frame["series"] == name]
        x = rows["tick"].map(ticks.index) + (index - (len(series) - 1) / 2) * step
        how = {**series_style(index), "linestyle": "none", "clip_on": False}
        ends = rows["low"].fillna(rows["value"]), rows["high"].fillna(rows["value"])
        axes.vlines(x, *ends, color=how["color"], linewidth=0.8)
        axes.plot(x, rows["value"], label=name, **how)
        if open_low:
            axes.plot(x, rows["low"], markerfacecolor="white", **how)
    axes.set_xticks(range(len(ticks)), [readable(tick).replace(" (", "\n(") for tick in ticks])
    axes.set_xlim(-0.5, len(ticks) - 0.5)
    axes.grid(visible=False, axis="x")


def bar_plot(axes: Axes, frame: pd.DataFrame, colours: Sequence[str] = ()) -> None:
    """Draw horizontal bars of (series, tick, value), those of a tick together, from the top.

    Up to three series have their values written beside the bars. `colours`: all series of a page,
    of which each has the same colour everywhere.
    """
    ticks, series = [*dict.fromkeys(frame["tick"])], [*dict.fromkeys(frame["series"])]
    thick = 0.8 / len(series)
    for index, name in enumerate(series):
        rows = frame[frame["series"] == name]
        at = rows["tick"].map(ticks.index) + (index - (len(series) - 1) / 2) * thick
        place = colours.index(name) if colours else index
        hatch = HATCHES[place // len(COLOURS) % len(HATCHES)]
        how: Any = {"color": series_style(place)["color"], "hatch": hatch, "edgecolor": "white"}
        bars = axes.barh(at, rows["value"], thick, label=name, linewidth=0, **how)
        if len(series) <= 3:
            axes.bar_label(bars, rows["value"].map("{:.1f}".format), padding=2, fontsize=SMALL)
    axes.set_yticks(range(len(ticks)), [folded(readable(tick), 1.1) for tick in ticks])
    axes.set_ylim(len(ticks) - 0.5, -0.5)
    axes.grid(visible=False, axis="y")


def heat(
    axes: Axes,
    picture: NDArray[Any],
    borders: NDArray[np.integer] | None = None,
    numbers: Sequence[str] = (),
    inches: float = COLUMN,
    **how: Any,
) -> Artist:
    """Draw a heat map (H, W), or an image (H, W, 3) uint8, without ticks and frame.

    `borders`: (H, W) regions; lines between them, dark below bright, show on any picture, and
    `numbers`, a text for each, on a white ground. `inches`: width of the picture.
    """
    shown = axes.imshow(picture, **how)
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)
    if borders is not None and borders.max() > 0:
        levels = np.arange(0.5, int(borders.max()) + 0.5)
        for line, width in (("black", 1.6), ("white", 0.7)):
            axes.contour(borders, levels, colors=line, linewidths=width)
    if borders is not None and numbers:
        box = {"boxstyle": "round,pad=0.06", "facecolor": "white", "alpha": 0.85, "linewidth": 0}
        at: Any = {"ha": "center", "va": "center", "fontsize": SMALL, "bbox": box}
        step = round((max(map(len, numbers)) + 1) * DIGIT * borders.shape[1] / inches)
        for place, text in zip(staircase(borders, step), numbers, strict=True):
            if place is not None:
                axes.text(place[1], place[0], text, **at)
    return shown


def staircase(region_map: NDArray[np.integer], step: int) -> list[tuple[int, int] | None]:
    """Return (row, column) for a text in each region; None for an empty one.

    Rings are too narrow for texts one above the other: they go `step` pixels further to the left
    and to the right in turn, as far as their ring reaches.
    """
    places = number_places(region_map.astype(np.int64), int(region_map.max()) + 1)
    row, middle = region_map.shape[0] // 2, region_map.shape[1] // 2
    turn = 0
    for region, place in enumerate(places):
        line = region_map[row] == region
        is_ring = line[:middle].any() and line[middle:].any() and not line[middle]
        if place is None or not is_ring:
            continue
        column = place[1] + (turn + 1) // 2 * step * (-1) ** turn
        if 0 <= column < region_map.shape[1] and region_map[place[0], column] == region:
            places[region] = (place[0], column)
        turn += 1
    return places


# Classes below a grid of pictures: K names, (K, 3) uint8 colours, and further entries.
Legend = tuple[Sequence[str], NDArray[np.uint8], Sequence[Artist]]


@styled
def picture_grid(
    rows: Sequence[Sequence[NDArray[Any]]],
    names: Sequence[str],
    titles: Sequence[str],
    layout: str = "rows",
    legend: Legend | None = None,
) -> tuple[Figure, NDArray[Any]]:
    """Draw pictures across a page, all of the same size, (H, W, 3) uint8, with a legend below.

    A row per name and a column per title, or, with "columns", the other way round. Returns the
    figure, and the axes of every name and title, whatever the layout.
    """
    is_columns = layout == "columns"
    across, down = (names, titles) if is_columns else (titles, names)
    height, width = rows[0][0].shape[:2]
    cell = (PAGE - 0.25) / len(across)
    tall = cell * height / width
    above = [folded(text, cell) for text in across]
    top = 0.2 + LINE * max(text.count("\n") for text in above)
    classes, palette, more = legend or ((), (), ())
    patches: list[Artist] = [
        Patch(facecolor=colour / 255.0, edgecolor="black", linewidth=0.4, label=readable(name))
        for name, colour in zip(classes, palette, strict=True)
    ]
    patches += more
    lines = -(-len(patches) // int(PAGE / LEGEND_ENTRY))
    figure = new_figure(PAGE, len(down) * (tall + 0.02) + top + 0.06 + 0.15 * lines)
    figure.set_layout_engine("compressed", w_pad=0.02, h_pad=0.02, wspace=0.0, hspace=0.0)
    axes = figure.subplots(len(down), len(across), squeeze=False)
    by_name = axes.T if is_columns else axes
    for of_name, pictures in zip(by_name, rows, strict=True):
        for cell_axes, picture in zip(of_name, pictures, strict=True):
            heat(cell_axes, picture)
    for one, text in zip(axes[0], above, strict=True):
        one.set_title(text)
    for one, text in zip(axes[:, 0], down, strict=True):
        one.set_ylabel(folded(text, tall), fontsize=SMALL)
    if patches:
        how: Any = {"loc": "outside lower center", "handlelength": 1.2, "columnspacing": 1.0}
        figure.legend(handles=patches, ncols=-(-len(patches) // lines), **how)
    return figure, by_name


def in_corner(axes: Axes, text: str) -> None:
    """Write a short text in the lower right corner of a picture, on a white ground."""
    box = {"boxstyle": "square,pad=0.15", "facecolor": "white", "alpha": 0.85, "linewidth": 0}
    at: Any = {"transform": axes.transAxes, "ha": "right", "va": "bottom"}
    axes.text(0.985, 0.02, text, fontsize=TINY, bbox=box, **at)


def region_axis(axes: Axes, regions: int, label: str = "region") -> None:
    """Make a horizontal axis with a tick at each of the regions 1..R."""
    axes.set_xticks(range(1, regions + 1, max(1, -(-regions // 12))))
    axes.set_xlim(0.6, regions + 0.4)
    axes.set_xlabel(label)


def series_legend(figure: Figure, axes: Axes, columns: int) -> None:
    """Draw the legend of one panel below all of them; long labels in fewer columns."""
    handles, labels = axes.get_legend_handles_labels()
    width = figure.get_figwidth()
    fitting = int(width * LETTERS_PER_INCH / (max(map(len, labels)) + HANDLE_LETTERS))
    columns = max(1, min(columns, fitting))
    labels = [folded(label, width - 0.6) for label in labels]
    figure.set_figheight(figure.get_figheight() + LINE * (-(-len(labels) // columns) - 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, columnspacing=1.2)


def folded(text: str, inches: float) -> str:
    """Break `text` into lines of at most `inches`; its own lines stay apart."""
    width = max(8, int(inches * LETTERS_PER_INCH))
    return "\n".join(textwrap.fill(line, width) for line in text.split("\n"))


def readable(name: str) -> str:
    """Write a class name as text: "car_stop" -> "car stop"."""
    return name.replace("_", " ")
