"""Effects of a design as grids, as tidy CSV and as a figure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable, csv_text
from sweeps.rendering.table import plain
from sweeps.table.design import TRAINED, Design
from sweeps.verdicts.effects import MEAN, DesignEffects, EffectLine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HEADER = (
    *("method", "effect", "difference", "95 % interval", "shown"),
    *("of seeds", "of images", "seeds"),
)
CSV_HEADER = (
    *("part", "outcome", "method", "against", "effect", "value", "low", "high", "p", "p_holm"),
    *("shown", "error_seeds", "error_images", "seeds", "cells"),
)
ASKS = {
    TRAINED: "trained and tested in each cell",
    "tested": "trained without any factor, tested in each cell",
}
NOTES = (
    "difference: mean at the high level less mean at the low level; of an interaction half of the "
    "difference of two effects. of seeds, of images: standard errors.",
    "shown: differs from 0 at the 5 % level, corrected for the number of main effects, or of "
    "interactions, of the method (Holm). The intervals are not corrected.",
)
COLOURS = ("#000000", "#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9")
"""Of Okabe and Ito, which colour-blind eyes tell apart; methods in their order."""

SPAN = 0.62
"""Part of the height of a row over which the methods are spread."""


def effects_grids(effects: DesignEffects, design: Design) -> list[TextTable]:
    """One grid for each part and outcome; the factors and what is missing below the last."""
    rows: dict[str, list[tuple[str, ...]]] = {}
    for line in effects.lines:
        found = line.estimate
        around = found.both
        interval = ABSENT if around is None else f"[{around.low:+.2f}, {around.high:+.2f}]"
        errors = (ABSENT if math.isnan(each) else f"{each:.2f}" for each in _errors(line))
        title = f"Effects on {line.outcome}, {ASKS[line.part]}"
        method = f"{line.method} - {line.against}" if line.against else line.method
        numbers = (f"{found.value:+.2f}", interval, word(line), *errors, str(found.seeds))
        rows.setdefault(title, []).append((method, line.effect, *numbers))
    levels = [f"{f.letter}, {f.name}: - {f.low_means}; + {f.high_means}." for f in design.factors]
    notes = (*(*levels, *NOTES) * bool(rows), *effects.missing)
    if notes and not rows:
        rows["Effects"] = []
    last = list(rows)[-1:]
    return [
        TextTable(title, HEADER, tuple(each), notes if [title] == last else ())
        for title, each in rows.items()
    ]


def word(line: EffectLine) -> str:
    """Whether the effect is shown; the mean of all cells is not tested."""
    estimate = line.estimate
    if line.effect == MEAN and not line.against:
        return ABSENT
    if estimate.both is None:
        return "2 seeds needed" if estimate.seeds < 2 else "too few images"
    if not line.is_shown:
        return "no"
    return "higher" if estimate.value > 0 else "lower"


def effects_csv(lines: Sequence[EffectLine]) -> str:
    """One line for each effect, with the columns of `CSV_HEADER`; empty where there is no value."""
    rows: list[tuple[object, ...]] = [CSV_HEADER]
    for line in lines:
        found, around = line.estimate, line.estimate.both
        ends = (math.nan,) * 3 if around is None else (around.low, around.high, found.p)
        names = (line.part, line.outcome, line.method, line.against, line.effect)
        numbers = map(plain, (found.value, *ends, line.corrected))
        errors = map(plain, _errors(line))
        rows.append((*names, *numbers, word(line), *errors, found.seeds, line.cells))
    return csv_text(rows)


def _errors(line: EffectLine) -> tuple[float, float]:
    """Standard errors over seeds and over images; NaN where there is none."""
    evidence = line.estimate.evidence
    return math.nan if evidence.trainings is None else evidence.trainings.error, evidence.error


def effects_figure(effects: DesignEffects, name: str) -> Figure | None:
    """A row of panels for each part, one panel per outcome; filled markers: shown to differ from 0.

    Returns:
        None where no effect has an interval.
    """
    from matplotlib.figure import Figure

    lines = [
        line
        for line in effects.lines
        if not line.against and line.effect != MEAN and line.estimate.both is not None
    ]
    if not lines:
        return None
    parts, outcomes, methods = (
        list(dict.fromkeys(getattr(line, key) for line in lines))
        for key in ("part", "outcome", "method")
    )
    heights = [len({line.effect for line in lines if line.part == part}) for part in parts]
    size = (2.6 + 2.9 * len(outcomes), 1.3 + 0.42 * sum(heights))
    figure = Figure(figsize=size, layout="constrained")
    panels = figure.subplots(
        len(parts), len(outcomes), sharey="row", squeeze=False, height_ratios=heights
    )
    for row, part in zip(panels, parts, strict=True):
        for axes, outcome in zip(row, outcomes, strict=True):
            chosen = [line for line in lines if (line.part, line.outcome) == (part, outcome)]
            _panel(axes, chosen, methods)
            axes.set_title(outcome, fontsize=9)
        row[0].set_ylabel(ASKS[part], fontsize=8)
    figure.suptitle(f"{name}: effects with 95 % intervals", fontsize=10)
    handles, labels = panels[0][0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=6, fontsize=8)
    return figure


def _panel(axes: Axes, lines: Sequence[EffectLine], methods: Sequence[str]) -> None:
    """Effects below each other; the methods of an effect close together."""
    effects = list(dict.fromkeys(line.effect for line in lines))
    for place, method in enumerate(methods):
        own = [line for line in lines if line.method == method]
        shift = SPAN * ((place + 0.5) / len(methods) - 0.5)
        at = [effects.index(line.effect) + shift for line in own]
        colour = COLOURS[place % len(COLOURS)]
        halves = [line.estimate.both.half for line in own if line.estimate.both]
        values = [line.estimate.value for line in own]
        faces = [colour if word(line) in ("higher", "lower") else "white" for line in own]
        axes.errorbar(
            values, at, xerr=halves, fmt="none", ecolor=colour, elinewidth=1, capsize=2, zorder=2
        )
        axes.scatter(values, at, c=faces, edgecolors=colour, s=22, zorder=3)
        axes.plot([], [], "o", color=colour, ms=5, label=method)
    axes.axvline(0, color="grey", lw=0.8, zorder=1)
    axes.set_yticks(range(len(effects)), effects, fontsize=8)
    axes.set_ylim(len(effects) - 0.5, -0.5)
    axes.tick_params(axis="x", labelsize=8)
    axes.grid(axis="x", alpha=0.25)
