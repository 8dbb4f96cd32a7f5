"""Effects of a design as grids and as a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable, number
from sweeps.judge.effects import MEAN
from sweeps.plan.design import TESTED, TRAINED, Design

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADER: tuple[str, ...] = ("method", "effect", "difference", "95 % interval", "shown")
HEADER += ("of seeds", "of images", "seeds")
ASKS = {
    TRAINED: "trained and tested in each cell",
    TESTED: "trained without any factor, tested in each cell",
}
NOTES = (
    "difference: mean at the high level less mean at the low level; of an interaction half of the "
    "difference of two effects. of seeds, of images: standard errors.",
    "shown: differs from 0 at the 5 % level, corrected for the number of main effects, or of "
    "interactions, of the method (Holm). The intervals are not corrected. explored: by other seeds "
    "than those that the table declares, which decide.",
)
# Part of the height of a row over which the methods are spread.
SPAN = 0.62


def effects_grids(frame: pd.DataFrame, lacking: Sequence[str], design: Design) -> list[TextTable]:
    """Return one grid for each part and outcome of `sweeps.judge.effects.effects_of`.

    The factors, and the methods that lack runs, are noted below the last.
    """
    titles, bodies = [], []
    for (part, outcome), lines in frame.groupby(["part", "outcome"], sort=False):
        titles.append(f"Effects on {outcome}, {ASKS[part]}")
        bodies.append(tuple(_grid_row(line) for _, line in lines.iterrows()))
    notes: list[str] = []
    if bodies:
        for factor in design.factors:
            levels = f"- {factor.low_means}; + {factor.high_means}."
            notes.append(f"{factor.letter}, {factor.name}: {levels}")
        notes += NOTES
    elif lacking:
        titles, bodies = ["Effects"], [()]
    notes += lacking
    last = len(bodies) - 1
    return [
        TextTable(title, HEADER, rows, tuple(notes) if place == last else ())
        for place, (title, rows) in enumerate(zip(titles, bodies, strict=True))
    ]


def _grid_row(line: pd.Series) -> tuple[str, ...]:
    interval = ABSENT
    if not math.isnan(line["low"]):
        interval = f"[{line['low']:+.2f}, {line['high']:+.2f}]"
    return (
        f"{line['method']} - {line['against']}" if line["against"] else line["method"],
        line["effect"],
        f"{line['value']:+.2f}",
        interval,
        line["shown"],
        number(line["error_seeds"]),
        number(line["error_images"]),
        str(line["seeds"]),
    )


def effects_figure(frame: pd.DataFrame, name: str) -> Figure | None:
    """Draw a row of panels for each part, one panel per outcome.

    Filled markers are shown to differ from 0. `frame` is that of `sweeps.judge.effects.effects_of`.

    Returns:
        None where no effect has an interval.
    """
    from matplotlib.figure import Figure

    frame = frame[(frame["against"] == "") & (frame["effect"] != MEAN) & frame["low"].notna()]
    if frame.empty:
        return None
    parts, outcomes = frame["part"].unique(), frame["outcome"].unique()
    methods = list(frame["method"].unique())
    heights = [frame[frame["part"] == part]["effect"].nunique() for part in parts]
    size = (2.6 + 2.9 * len(outcomes), 1.3 + 0.42 * sum(heights))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(
        len(parts), len(outcomes), sharey="row", squeeze=False, height_ratios=heights
    )
    for row, part in zip(panels, parts, strict=True):
        for axes, outcome in zip(row, outcomes, strict=True):
            chosen = (frame["part"] == part) & (frame["outcome"] == outcome)
            _panel(axes, frame[chosen], methods)
            axes.set_title(outcome, fontsize=9)
        row[0].set_ylabel(ASKS[part], fontsize=8)
    figure.suptitle(f"{name}: effects with 95 % intervals", fontsize=10)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8)
    return figure


def _panel(axes: Axes, lines: pd.DataFrame, methods: list[str]) -> None:
    """Effects below each other; the methods of an effect close together."""
    from analysis.figures.plots import series_style

    effects = list(lines["effect"].unique())
    for place, method in enumerate(methods):
        own = lines[lines["method"] == method]
        shift = SPAN * ((place + 0.5) / len(methods) - 0.5)
        at = [effects.index(effect) + shift for effect in own["effect"]]
        colour = series_style(place)["color"]
        halves = (own["high"] - own["low"]) / 2
        faces = [colour if word in ("higher", "lower") else "white" for word in own["shown"]]
        axes.errorbar(
            own["value"], at, xerr=halves, fmt="none", ecolor=colour, elinewidth=1, capsize=2
        )
        axes.scatter(own["value"], at, c=faces, edgecolors=colour, s=22, zorder=3)
        axes.plot([], [], "o", color=colour, ms=5, label=method)
    axes.axvline(0, color="grey", lw=0.8, zorder=1)
    axes.set_yticks(range(len(effects)), effects, fontsize=8)
    axes.set_ylim(len(effects) - 0.5, -0.5)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(axis="x", alpha=0.25)
