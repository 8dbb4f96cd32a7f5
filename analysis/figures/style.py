"""Style of all figures: sizes of a paper's column, fonts, colours for colour-blind readers.

Figures are drawn without pyplot (no display, no global state). `styled` sets sizes and letters
while something is drawn; `save` keeps text as text in PDF and SVG.
"""

from __future__ import annotations

import io
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter
from numpy.typing import NDArray

from analysis.arguments import check_out
from rgbt.checks import InputError
from rgbt.files.atomic import write_atomic

COLUMN, PAGE = 3.4, 7.0
"""Width in inches of one column and of a page of two columns (IEEE)."""

TINY, SMALL, NORMAL = 5.0, 7.0, 8.0
"""Points of numbers on small pictures, of other small letters (ticks, legends), and of titles."""

LETTERS_PER_INCH = 17
"""Of labels and titles, on average."""

HANDLE_LETTERS = 7
"""Letters whose room the line and the gap of a legend's entry take."""

LEGEND_ENTRY = 0.72
"""Inches that a class takes in a legend."""

SUFFIXES = (".pdf", ".svg", ".png")
PNG_DPI = 300

COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7"),
    *("#E69F00", "#56B4E9", "#777777", "#999933"),
)
"""Okabe and Ito's, the strong ones first; grey and olive (Tol) instead of their yellow, which is
lost as a thin line on white, and of black, which stands for what is set apart."""

APART = "black"

MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<")
LINES = ("-", "--", "-.", ":")
MAP_COLOURS = "viridis"

RC: Any = {
    "font.size": NORMAL,
    "axes.titlesize": NORMAL,
    "axes.labelsize": NORMAL,
    "xtick.labelsize": SMALL,
    "ytick.labelsize": SMALL,
    "legend.fontsize": SMALL,
    "legend.frameon": False,
    "legend.handlelength": 2.4,
    "legend.borderpad": 0.1,
    "legend.borderaxespad": 0.2,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "xtick.major.width": 0.6,
    "ytick.major.width": 0.6,
    "axes.grid": True,
    "grid.alpha": 0.25,
    "grid.linewidth": 0.5,
    "axes.axisbelow": True,
    "lines.linewidth": 1.1,
    "lines.markersize": 3.5,
    "hatch.linewidth": 0.5,
    "image.interpolation": "none",  # PDF and SVG keep the pixels of the image
    "pdf.fonttype": 42,  # letters stay letters: they can be searched, and journals ask for it
    "svg.fonttype": "none",
    "svg.hashsalt": "rgbt",  # the same data gives the same file
}


styled = rc_context(RC)
"""Decorator: draw with the letters, lines and sizes of `RC`."""


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of `width` x `height` inches that makes room for its labels."""
    figure = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def pack(figure: Figure) -> None:
    """Leave only a hair between the panels: pictures of one scene side by side."""
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.01, wspace=0.01, hspace=0.01)


def out_path(out: str) -> Path:
    """The file that ``out=`` names; InputError for another ending, or where none can be written."""
    path = Path(out).expanduser()
    if path.suffix.lower() not in SUFFIXES:
        raise InputError(
            f"out={out}: expected a name that ends in {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]}"
            f", got '{path.suffix}'; for example out=figure.pdf."
        )
    check_out(path.parent)
    return path


@styled
def save(figure: Figure, path: Path) -> None:
    """Write `figure` at its size: PDF and SVG with text as text, PNG at 300 dots per inch."""
    kind = out_path(str(path)).suffix.lower()[1:]
    # Without the time of day the same data gives the same file.
    dated = {"pdf": {"CreationDate": None}, "svg": {"Date": None}, "png": {}}[kind]
    content = io.BytesIO()
    figure.savefig(content, format=kind, dpi=PNG_DPI, metadata=dated)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content.getvalue())


def series_style(index: int) -> dict[str, Any]:
    """Colour, marker and line of series `index`; no two of the first 32 agree in all three."""
    turn, place = divmod(index, len(COLOURS))
    return {
        "color": COLOURS[place],
        "marker": MARKERS[(place + turn) % len(MARKERS)],
        "linestyle": LINES[(index + turn) % len(LINES)],
    }


def show_image(axes: Axes, picture: NDArray[Any], **how: Any) -> Artist:
    """Draw an image without ticks and frame; `how` goes to ``imshow``."""
    shown = axes.imshow(picture, **how)
    axes.set(xticks=[], yticks=[])
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)
    return shown


def region_axis(axes: Axes, regions: int, label: str = "region") -> None:
    """A horizontal axis with a tick at each of the regions 1..R."""
    step = max(1, -(-regions // 12))
    axes.set_xticks(range(1, regions + 1, step))
    axes.set_xlim(0.6, regions + 0.4)
    axes.set_xlabel(label)


def draw_borders(axes: Axes, region_map: NDArray[np.integer]) -> None:
    """Lines between the regions (H, W), dark below bright so that they show on any picture."""
    levels = np.arange(0.5, int(region_map.max()) + 0.5)
    if len(levels) == 0:
        return
    for line, width in (("black", 1.6), ("white", 0.7)):
        axes.contour(region_map, levels, colors=line, linewidths=width)


def number(axes: Axes, place: tuple[int, int], text: str) -> None:
    """A number on a picture at (row, column), on a white ground."""
    box = {"boxstyle": "round,pad=0.06", "facecolor": "white", "alpha": 0.85, "linewidth": 0}
    at = {"ha": "center", "va": "center", "fontsize": SMALL, "bbox": box}
    axes.text(place[1], place[0], text, **at)  # type: ignore[arg-type]


def in_corner(axes: Axes, text: str) -> None:
    """A short text in the lower right corner of a picture, on a white ground."""
    box = {"boxstyle": "square,pad=0.15", "facecolor": "white", "alpha": 0.85, "linewidth": 0}
    at: Any = {"transform": axes.transAxes, "ha": "right", "va": "bottom"}
    axes.text(0.985, 0.02, text, fontsize=TINY, bbox=box, **at)


def class_legend(
    figure: Figure,
    names: Sequence[str],
    palette: NDArray[np.uint8],
    more: Sequence[Artist] = (),
) -> None:
    """Names of classes with their colours, and `more` entries, below everything."""
    patches: list[Artist] = [
        Patch(facecolor=colour / 255.0, edgecolor="black", linewidth=0.4, label=readable(name))
        for name, colour in zip(names, palette, strict=True)
    ]
    patches += more
    columns = max(1, min(len(patches), int(figure.get_figwidth() / LEGEND_ENTRY)))
    rows = -(-len(patches) // columns)
    columns = -(-len(patches) // rows)
    figure.legend(
        handles=patches,
        loc="outside lower center",
        ncols=columns,
        handlelength=1.2,
        columnspacing=1.0,
    )


def legend_height(width: float, classes: int) -> float:
    """Inches that `class_legend` takes of a figure of that width."""
    return 0.06 + 0.15 * -(-classes // max(1, int(width / LEGEND_ENTRY)))


def log_axis(axes: Axes) -> None:
    """A logarithmic vertical axis whose ticks say numbers, also within a decade."""
    axes.set_yscale("log")
    axes.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def folded(text: str, inches: float) -> str:
    """`text` on as many lines as it needs to stand within `inches`; its own lines stay apart."""
    width = max(8, int(inches * LETTERS_PER_INCH))
    return "\n".join(textwrap.fill(line, width) for line in text.split("\n"))


def series_legend(figure: Figure, axes: Axes, columns: int) -> None:
    """The legend of one of the panels, below all of them; long labels in fewer columns."""
    handles, labels = axes.get_legend_handles_labels()
    width = figure.get_figwidth()
    fitting = int(width * LETTERS_PER_INCH / (max(map(len, labels)) + HANDLE_LETTERS))
    columns = max(1, min(columns, fitting))
    labels = [folded(label, width - 0.6) for label in labels]
    lines = -(-len(labels) // columns)
    figure.set_figheight(figure.get_figheight() + 0.14 * (lines - 1))
    figure.legend(handles, labels, loc="outside lower center", ncols=columns, columnspacing=1.2)


def readable(name: str) -> str:
    """A class name as text: "car_stop" -> "car stop"."""
    return name.replace("_", " ")


def say_splits(figure: Figure, splits: tuple[str, str]) -> None:
    """A note above the figure where occupancy and scores are of different splits."""
    occupancy, scores = splits
    if scores and occupancy != scores:
        figure.suptitle(f"SOR: split {occupancy}; scores: split {scores}", fontsize=SMALL)
