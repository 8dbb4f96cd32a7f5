"""Scores of each method under corruptions: one panel per corruption, severity along x."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput, check_same_images
from analysis.robustness import CLEAN, Level, Training, trainings
from rgbt.checks import InputError, nearest, split_list
from rgbt.metrics.metric import Absent
from rgbt.metrics.scores import miou
from rgbt.runs.naming import row_name
from rgbt.tables import TextTable, csv_text, number

Floats = NDArray[np.float64]

COLUMNS = 4
HEIGHT = 1.55
HEIGHT_BELOW = 1.35
"""Inches of a line of panels, and of the panel below them."""

ROW = "degradation"
"""Header of the column of corruptions in the tables beside the figure; files depend on it."""

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

    def summary(self, relative: bool) -> tuple[Floats, Floats]:
        """(S,) mean and standard deviation (n - 1) over trainings; NaN deviation of one alone.

        Relative: in percent of what each training reaches on clean images.
        """
        values = 100 * self.mious / self.mious[:, :1] if relative else self.mious
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


def make(given: FigureInput) -> Figure:
    """The figure; relative to the clean images by its name."""
    return draw(_given_panels(given), relative=given.figure.endswith("/relative"))


def make_numbers(given: FigureInput) -> dict[str, str]:
    """The numbers of both figures."""
    return numbers(_given_panels(given))


def _given_panels(given: FigureInput) -> tuple[Panel, ...]:
    found = given.opened_runs("runs or groups; label:run names one", trainings)
    named = given.get("corruptions", "")
    rows = split_list(named, "corruptions") if named else []
    levels = (level for each in found.values() for training in each for level in training.levels)
    return panels(found, given.absent(level.counts for level in levels), rows)


def panels(
    methods: Mapping[str, Sequence[Training]], absent: Absent, rows: Sequence[str] = ()
) -> tuple[Panel, ...]:
    """The data of the figure.

    Args:
        methods: label -> trainings.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.
        rows: names of the corruptions to show; (): all.

    Raises:
        InputError: methods on other images, or measured at different severities; a row that
            was not measured; only clean images.
    """
    by_method = {
        label: [level for training in each for level in training.levels]
        for label, each in methods.items()
    }
    check_same_images(
        {label: [level.counts for level in each] for label, each in by_method.items()}
    )
    first: dict[str, Level] = {}
    for level in (level for each in by_method.values() for level in each):
        first.setdefault(level.row, level)
    known = [row for row in first if row != CLEAN]
    if not known:
        raise InputError(
            "runs: only clean images were measured; measure the corruptions with rgbt robustness."
        )
    shown = [row_name(row) for row in rows] or known
    for row in shown:
        if row not in known:
            raise InputError(f"corruptions: '{row}' was not measured; {nearest(row, known)}.")
    words = [first[row] for row in shown if not first[row].unit]
    made = []
    if words:  # clean, and each row without a severity, side by side
        ticks = (CLEAN, *(level.title for level in words))
        curves = _curves(
            methods,
            lambda t: [next(iter(t.of(level.row)), None) for level in words],
            absent,
        )
        made.append(Panel("", MISSING, "", tuple(map(float, range(len(ticks)))), ticks, curves))
    made += [_panel(methods, first[row], absent) for row in shown if first[row].unit]
    return tuple(made)


def _panel(methods: Mapping[str, Sequence[Training]], like: Level, absent: Absent) -> Panel:
    ladders = {
        label: {tuple(level.severity for level in t.of(like.row)) for t in each}
        for label, each in methods.items()
    }
    measured = {label: found for label, found in ladders.items() if found != {()}}
    if len(set().union(*measured.values())) > 1:
        measured_at = "; ".join(
            f"of '{label}' at {' and '.join(str([*ladder]) for ladder in sorted(found))}"
            for label, found in measured.items()
        )
        raise InputError(
            f"runs: {like.row} was measured {measured_at}; rgbt robustness measures the rest."
        )
    severities = next(iter(next(iter(measured.values()))))
    curves = _curves(methods, lambda t: t.of(like.row) or [None] * len(severities), absent)
    return Panel(like.row, like.title, like.unit, (0.0, *severities), (), curves)


def _curves(
    methods: Mapping[str, Sequence[Training]],
    chosen: Callable[[Training], Sequence[Level | None]],
    absent: Absent,
) -> tuple[Curve, ...]:
    """Of every method the clean images and then the `chosen` levels of each training."""

    def score(level: Level | None) -> float:
        if level is None:
            return math.nan
        return float(100 * miou(level.counts.whole(), absent, level.counts.scored))

    return tuple(
        Curve(
            label, np.array([[score(level) for level in (t.levels[0], *chosen(t))] for t in each])
        )
        for label, each in methods.items()
    )


@style.styled
def draw(data: Sequence[Panel], *, relative: bool) -> Figure:
    """One panel per corruption; mean over trainings, band of one standard deviation.

    The dashed line is the score on clean images. Missing images stand side by side below.

    Relative: percent of the score on clean images, for every training separately.
    """
    curves = [panel for panel in data if not panel.ticks]
    below = [panel for panel in data if panel.ticks]
    lines, columns = -(-len(curves) // COLUMNS), min(COLUMNS, max(1, len(curves)))
    width = style.PAGE * max(columns, 2 + len(below)) / COLUMNS
    figure = style.new_figure(width, HEIGHT * lines + HEIGHT_BELOW * len(below) + 0.25)
    heights = [*[HEIGHT] * lines, *[HEIGHT_BELOW] * len(below)]
    grid = figure.add_gridspec(len(heights), columns, height_ratios=heights)
    first: Axes | None = None
    for index, panel in enumerate([*curves, *below]):
        line, column = (lines, 0) if panel.ticks else divmod(index, COLUMNS)
        place = grid[line, :] if panel.ticks else grid[line, column]
        axes = figure.add_subplot(place, sharey=first)
        first = first or axes
        _draw_panel(axes, panel, relative)
        room = width if panel.ticks else width / columns
        axes.set_title(style.folded(panel.title, room - 0.3), fontsize=style.SMALL)
        axes.tick_params(labelleft=column == 0)
        if column == 0:
            axes.set_ylabel("% of clean mIoU" if relative else "mIoU (%)")
    assert first is not None, "a figure has a panel"
    first.set_ylim(0, 1.08 * first.get_ylim()[1])
    style.series_legend(figure, first, columns=4)
    return figure


def _draw_panel(axes: Axes, panel: Panel, relative: bool) -> None:
    """Lines with bands over the severities, or markers with bars over words."""
    step = min(0.15, 0.7 / len(panel.curves))
    for index, curve in enumerate(panel.curves):
        means, spreads = curve.summary(relative)
        seeds = len(curve.mious)
        how: dict[str, Any] = style.series_style(index)  # dashes are for clean images
        how |= {"label": f"{curve.method} ({seeds} seed{'s' if seeds > 1 else ''})"}
        axes.axhline(means[0], color=how["color"], linestyle="--", linewidth=0.6, zorder=1)
        if panel.ticks:
            x = np.array(panel.severities) + (index - (len(panel.curves) - 1) / 2) * step
            how |= {"linestyle": "none", "elinewidth": 0.7}
            axes.errorbar(x, means, None if seeds == 1 else spreads, **how)
            continue
        axes.plot(panel.severities, means, **{**how, "linestyle": "-"})
        ends = means - spreads, means + spreads
        axes.fill_between(panel.severities, *ends, color=how["color"], alpha=0.2, linewidth=0)
    if panel.ticks:
        axes.set_xticks(panel.severities, [tick.replace(" (", "\n(") for tick in panel.ticks])
        axes.set_xlim(-0.5, len(panel.ticks) - 0.5)
        axes.grid(visible=False, axis="x")
        return
    axes.set_xticks(panel.severities, [f"{severity:g}" for severity in panel.severities])
    axes.set_xlabel(panel.unit, fontsize=style.SMALL)


def numbers(data: Sequence[Panel]) -> dict[str, str]:
    """Ending of a file -> its text: the figure's numbers as a table, and as CSV with all digits."""
    header = (ROW, "severity", "unit", "method", "seeds", "mIoU", "sd")
    lines: list[tuple[object, ...]] = [(*header, "relative", "relative_sd")]
    rows = []
    # The clean images are in every panel, and once in the table.
    places = [(p, at) for n, p in enumerate(data) for at in range(min(n, 1), len(p.severities))]
    for panel, place in places:
        said = (panel.title, f"{panel.severities[place]:g}")
        if panel.ticks:
            said = (panel.ticks[place], "")
        said = said if place else (CLEAN, "0")
        cells = []
        for curve in panel.curves:
            if np.isnan(curve.mious[:, place]).any():
                cells.append("")
                continue
            both = [each[place] for kind in (False, True) for each in curve.summary(kind)]
            plain = ["" if math.isnan(each) else each for each in both]
            lines.append((*said, panel.unit, curve.method, len(curve.mious), *plain))
            spread = "" if math.isnan(both[1]) else f" ± {both[1]:.2f}"
            cells.append(f"{number(both[0])}{spread} ({both[2]:.1f} %)")
        rows.append((*said, *cells))
    title = "mIoU in percent, mean ± standard deviation over seeds (percent of the clean mIoU)"
    methods = [curve.method for curve in data[0].curves]
    grid = TextTable(title, (ROW, "severity", *methods), tuple(rows))
    return {".md": grid.to_markdown(), ".csv": csv_text(lines)}
