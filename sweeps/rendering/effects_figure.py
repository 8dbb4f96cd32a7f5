"""The figure of a design: its effects with intervals, by method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from sweeps.rendering.effects import ASKS, word
from sweeps.rendering.figure import write_png
from sweeps.verdicts.effects import MEAN, DesignEffects, EffectLine

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

COLOURS = ("#000000", "#0072B2", "#009E73", "#D55E00", "#CC79A7", "#E69F00", "#56B4E9")
"""Of Okabe and Ito, which colour-blind eyes tell apart; methods in their order."""

SPAN = 0.62
"""Part of the height of a row over which the methods are spread."""


def draw_effects(effects: DesignEffects, name: str, path: Path) -> bool:
    """Draw the figure as PNG; whether there was anything to draw."""
    return write_png(effects_figure(effects, name), path)


def shown_lines(effects: DesignEffects) -> list[EffectLine]:
    """The effects of single methods with an interval."""
    return [
        line
        for line in effects.lines
        if not line.against and line.effect != MEAN and line.estimate.both is not None
    ]


def effects_figure(effects: DesignEffects, name: str) -> Figure | None:
    """A row of panels for each part, one panel per outcome; filled markers: shown to differ from 0.

    Returns:
        None where no effect has an interval.
    """
    from matplotlib.figure import Figure

    lines = shown_lines(effects)
    if not lines:
        return None
    parts = list(dict.fromkeys(line.part for line in lines))
    outcomes = list(dict.fromkeys(line.outcome for line in lines))
    methods = list(dict.fromkeys(line.method for line in lines))
    heights = [len({line.effect for line in lines if line.part == part}) for part in parts]
    figure = Figure(
        figsize=(2.6 + 2.9 * len(outcomes), 1.3 + 0.42 * sum(heights)), layout="constrained"
    )
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
