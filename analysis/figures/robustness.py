"""What is left of each method under corruptions: one panel per corruption, severity along x."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from analysis.figures.inputs import check_same_images
from analysis.figures.style import (
    PAGE,
    SMALL,
    folded,
    new_figure,
    series_legend,
    series_style,
    styled,
)
from analysis.robustness import CLEAN, Level, Training
from rgbt.checks import InputError, nearest
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import miou
from rgbt.spec.corruption_names import row_name
from rgbt.tracking.csv_files import csv_text
from rgbt.tracking.tables import TextTable, number

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]

COLUMNS = 4
HEIGHT = 1.55
HEIGHT_BELOW = 1.35
"""Inches of a line of panels, and of the panel below them."""

ROW = "degradation"
"""What the tables beside the figure have called the column of corruptions from the start."""

MISSING = "one image missing"
"""Title of the panel of corruptions without a severity."""


@dataclass(frozen=True)
class Curve:
    """One method in one panel.

    Attributes:
        mious: (T, S) percent, trainings x severities, the clean images first; NaN: not measured.
    """

    method: str
    mious: Floats

    @property
    def relative(self) -> Floats:
        """(T, S): percent of what each training reaches on clean images."""
        return 100 * self.mious / self.mious[:, :1]

    def summary(self, relative: bool) -> tuple[Floats, Floats]:
        """(S,) mean and standard deviation (n - 1) over trainings; NaN deviation of one alone."""
        values = self.relative if relative else self.mious
        spread = values.std(0, ddof=1) if len(values) > 1 else np.full(values.shape[1], np.nan)
        return values.mean(0), spread


@dataclass(frozen=True)
class Panel:
    """One corruption, or those without a severity together.

    Attributes:
        row: its name; "" of those together.
        unit: of the severities; "" where `ticks` are words.
        severities: (S,) 0 first; places of the ticks where these are words.
        ticks: words along x, or () for numbers.
    """

    row: str
    title: str
    unit: str
    severities: tuple[float, ...]
    ticks: tuple[str, ...]
    curves: tuple[Curve, ...]


def panels(
    methods: Mapping[str, Sequence[Training]], absent: Absent, rows: Sequence[str] = ()
) -> tuple[Panel, ...]:
    """The data of the figure.

    Args:
        methods: label -> its trainings.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.
        rows: names of the corruptions to show; (): all.

    Raises:
        InputError: methods on other images, or measured at different severities; a row that nobody
            has; clean images alone.
    """
    check_same_images(
        {
            label: [level.counts for training in each for level in training.levels]
            for label, each in methods.items()
        }
    )
    levels = [level for each in methods.values() for training in each for level in training.levels]
    known = list(dict.fromkeys(level.row for level in levels if level.row != CLEAN))
    if not known:
        raise InputError("runs: clean images alone were measured; rgbt robustness does.")
    rows = [row_name(row) for row in rows]
    for row in rows:
        if row not in known:
            raise InputError(f"corruptions: '{row}' was not measured; {nearest(row, known)}.")
    shown = list(rows) or known
    first = {level.row: level for level in reversed(levels)}
    words = [row for row in shown if not first[row].unit]
    made = [_missing(methods, [first[row] for row in words], absent)] if words else []
    made += [_panel(methods, first[row], absent) for row in shown if row not in words]
    return tuple(made)


def _panel(methods: Mapping[str, Sequence[Training]], like: Level, absent: Absent) -> Panel:
    ladders = {
        label: {tuple(level.severity for level in t.of(like.row)) for t in each}
        for label, each in methods.items()
    }
    measured = {label: found for label, found in ladders.items() if found != {()}}
    if len(set().union(*measured.values())) > 1:
        told = "; ".join(
            f"of '{label}' at {' and '.join(str([*ladder]) for ladder in sorted(found))}"
            for label, found in measured.items()
        )
        raise InputError(f"runs: {like.row} was measured {told}; rgbt robustness completes them.")
    severities = next(iter(next(iter(measured.values()))))
    curves = []
    for label, each in methods.items():
        levels = [t.of(like.row) or [None] * len(severities) for t in each]
        mious = [_mious([t.levels[0], *of], absent) for t, of in zip(each, levels, strict=True)]
        curves.append(Curve(label, np.array(mious)))
    return Panel(like.row, like.title, like.unit, (0.0, *severities), (), tuple(curves))


def _missing(
    methods: Mapping[str, Sequence[Training]], like: Sequence[Level], absent: Absent
) -> Panel:
    """Clean, and each row without a severity, side by side."""
    curves = []
    for label, each in methods.items():
        mious = []
        for training in each:
            levels = [next(iter(training.of(level.row)), None) for level in like]
            mious.append(_mious([training.levels[0], *levels], absent))
        curves.append(Curve(label, np.array(mious)))
    ticks = (CLEAN, *(level.title for level in like))
    return Panel("", MISSING, "", tuple(map(float, range(len(ticks)))), ticks, tuple(curves))


def _mious(levels: Sequence[Level | None], absent: Absent) -> list[float]:
    return [
        math.nan
        if level is None
        else float(100 * miou(level.counts.whole(), absent, level.counts.scored))
        for level in levels
    ]


@styled
def draw(data: Sequence[Panel], *, relative: bool) -> Figure:
    """One panel per corruption; mean over trainings, band of one standard deviation.

    The dashed line is the score on clean images. Missing images stand side by side below.

    Args:
        data: the panels.
        relative: percent of the score on clean images, of every training for itself.
    """
    curves = [panel for panel in data if not panel.ticks]
    below = [panel for panel in data if panel.ticks]
    lines, columns = -(-len(curves) // COLUMNS), min(COLUMNS, max(1, len(curves)))
    width = PAGE * max(columns, 2 + len(below)) / COLUMNS
    figure = new_figure(width, HEIGHT * lines + HEIGHT_BELOW * len(below) + 0.25)
    heights = [*[HEIGHT] * lines, *[HEIGHT_BELOW] * len(below)]
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    first: Axes | None = None
    for index, panel in enumerate([*curves, *below]):
        line, column = (lines, 0) if panel.ticks else divmod(index, COLUMNS)
        place = grid[line, :] if panel.ticks else grid[line, column]
        axes = figure.add_subplot(place, sharey=first)
        first = first or axes
        (_draw_words if panel.ticks else _draw_curves)(axes, panel, relative)
        room = width if panel.ticks else width / columns
        axes.set_title(folded(panel.title, room - 0.3), fontsize=SMALL)
        axes.tick_params(labelleft=column == 0)
        if column == 0:
            axes.set_ylabel("% of clean mIoU" if relative else "mIoU (%)")
    assert first is not None, "a figure has a panel"
    first.set_ylim(0, 1.08 * first.get_ylim()[1])
    series_legend(figure, first, columns=4)
    return figure


def _draw_curves(axes: Axes, panel: Panel, relative: bool) -> None:
    for index, curve in enumerate(panel.curves):
        means, spreads = curve.summary(relative)
        style = {**series_style(index), "linestyle": "-"}  # dashes are for clean images
        _draw_clean(axes, means[0], style)
        axes.plot(panel.severities, means, label=_said(curve), **style)
        low, high = means - spreads, means + spreads
        axes.fill_between(panel.severities, low, high, color=style["color"], alpha=0.2, linewidth=0)
    axes.set_xticks(panel.severities, [f"{severity:g}" for severity in panel.severities])
    axes.set_xlabel(panel.unit, fontsize=SMALL)


def _draw_words(axes: Axes, panel: Panel, relative: bool) -> None:
    step = min(0.15, 0.7 / len(panel.curves))
    for index, curve in enumerate(panel.curves):
        means, spreads = curve.summary(relative)
        style = {**series_style(index), "linestyle": "none"}
        _draw_clean(axes, means[0], style)
        x = np.array(panel.severities) + (index - (len(panel.curves) - 1) / 2) * step
        lengths = None if len(curve.mious) == 1 else spreads
        axes.errorbar(x, means, lengths, label=_said(curve), elinewidth=0.7, **style)
    axes.set_xticks(panel.severities, [tick.replace(" (", "\n(") for tick in panel.ticks])
    axes.set_xlim(-0.5, len(panel.ticks) - 0.5)
    axes.grid(visible=False, axis="x")


def _draw_clean(axes: Axes, value: float, style: Mapping[str, Any]) -> None:
    axes.axhline(value, color=style["color"], linestyle="--", linewidth=0.6, zorder=1)


def _said(curve: Curve) -> str:
    seeds = len(curve.mious)
    return f"{curve.method} ({seeds} seed{'s' if seeds > 1 else ''})"


def numbers(data: Sequence[Panel]) -> dict[str, str]:
    """Ending of a file -> its text: the figure's numbers as a table, and as CSV with all digits."""
    header = (ROW, "severity", "unit", "method", "seeds", "mIoU", "sd")
    lines: list[tuple[object, ...]] = [(*header, "relative", "relative_sd")]
    rows = []
    for panel, place, said in _places(data):
        cells = []
        for curve in panel.curves:
            if np.isnan(curve.mious[:, place]).any():
                cells.append("")
                continue
            both = [each[place] for kind in (False, True) for each in curve.summary(kind)]
            seeds = len(curve.mious)
            plain = ["" if math.isnan(each) else each for each in both]
            lines.append((*said, panel.unit, curve.method, seeds, *plain))
            spread = "" if math.isnan(both[1]) else f" ± {both[1]:.2f}"
            cells.append(f"{number(both[0])}{spread} ({both[2]:.1f} %)")
        rows.append((*said, *cells))
    title = "mIoU in percent, mean ± standard deviation over seeds (percent of the clean mIoU)"
    methods = [curve.method for curve in data[0].curves]
    grid = TextTable(title, (ROW, "severity", *methods), tuple(rows))
    return {".md": grid.to_markdown(), ".csv": csv_text(lines)}


def _places(data: Sequence[Panel]) -> list[tuple[Panel, int, tuple[str, str]]]:
    """(panel, column of its curves, (corruption, severity)) of every line of a table."""
    found = []
    for index, panel in enumerate(data):
        for place, severity in enumerate(panel.severities):
            if place == 0 and index > 0:
                continue  # clean once
            title = panel.ticks[place] if panel.ticks else panel.title
            said = (CLEAN, "0") if place == 0 else (title, "" if panel.ticks else f"{severity:g}")
            found.append((panel, place, said))
    return found
