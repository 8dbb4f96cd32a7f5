"""The figures of a study as PNGs, or the reason why one cannot be drawn."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweeps.report import drawing
from sweeps.report.axes import used_parameters
from sweeps.report.study_data import Importances, StudyData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_CONTOUR_TRIALS = 4
"""Fewest trials with both parameters from which a surface is drawn."""


CONTOUR_STYLE: Any = {
    "figure.figsize": (7.0, 5.2),
    "figure.dpi": 110,
    "figure.constrained_layout.use": True,
}


@dataclass(frozen=True)
class StudyFigure:
    """A figure of a study.

    Attributes:
        name: file name without extension.
        title: what it shows.
        path: the PNG, or None where there is none.
        reason: why there is none, else "".
    """

    name: str
    title: str
    path: Path | None
    reason: str = ""


def draw(data: StudyData, shares: Importances, folder: Path) -> list[StudyFigure]:
    """Write ``<name>.png`` of every figure for this kind of study.

    The points of a list have no parameters, hence no figures; a grid has those that do not show
    the course of a search. A figure of an earlier call that can no longer be drawn is removed.

    Args:
        data: the study.
        shares: `importances` of it.
        folder: where the files go; it exists.
    """
    pictures = []
    for name, title, reason, make in _figures(data, shares):
        path = folder / f"{name}.png"
        if reason:
            path.unlink(missing_ok=True)
            pictures.append(StudyFigure(name, title, None, reason))
        else:
            figure = make()
            figure.suptitle(f"{data.name}: {title}", fontsize=10)
            figure.savefig(path)
            pictures.append(StudyFigure(name, title, path))
    return pictures


FigureMaker = tuple[str, str, str, "Callable[[], Figure]"]


def _figures(data: StudyData, shares: Importances) -> Iterator[FigureMaker]:
    """(file name, title, why it cannot be drawn or "", function) for this kind of study."""
    if data.kind == "list":
        return
    incomplete = "" if data.complete else "no trial is complete yet."
    if data.kind == "search":
        history = partial(drawing.history, data)
        yield "history", "Objectives by trial", incomplete, history
        intermediate = partial(drawing.intermediate, data)
        reason = _without_reports(data)
        yield "intermediate", "Validation while training", reason, intermediate
    unimportant = "" if shares.shares else shares.remark
    bars = partial(drawing.importance_bars, data, shares)
    yield "importances", "Importance of the parameters", unimportant, bars
    if len(data.metrics) > 1:
        yield "pareto", "Pareto front", incomplete, partial(drawing.pareto, data)
    no_values = incomplete
    if data.complete and not used_parameters(data):
        no_values = "the complete trials have no parameters."
    lines = partial(drawing.parallel, data)
    yield "parallel", "Parallel coordinates, dark lines are best", no_values, lines
    for index, metric in enumerate(data.metrics):
        end = "" if len(data.metrics) == 1 else "_" + re.sub(r"\W+", "_", metric)
        slices = partial(drawing.slices, data, index)
        yield f"slices{end}", f"{metric} over each parameter", no_values, slices
        names = _most_important(shares, index)
        reason = _without_contour(data, shares, names, index)
        contour = partial(_contour, data, names, index)
        yield f"contour{end}", f"{metric} over two parameters", reason, contour


def _most_important(shares: Importances, index: int) -> list[str]:
    """The two most important parameters for one objective."""
    return sorted(shares.shares, key=lambda name: -shares.shares[name][index])[:2]


def _without_reports(data: StudyData) -> str:
    if len(data.metrics) > 1:
        return "trials with several objectives report no values while they train."
    has_reports = any(trial.intermediate_values for trial in data.trials)
    return "" if has_reports else "no trial has reported a value while it trained."


def _without_contour(data: StudyData, shares: Importances, names: list[str], index: int) -> str:
    """Why there is no surface over the two most important parameters of an objective, or ""."""
    if not names:
        return f"it shows the two most important parameters: {shares.remark}"
    if len(names) < 2:
        return "only one parameter took two values."
    if math.isnan(next(iter(shares.shares.values()))[index]):
        return f"{data.metrics[index]} has the same value in all trials."
    both = [trial for trial in data.complete if all(name in trial.params for name in names)]
    if len(both) < MIN_CONTOUR_TRIALS:
        return f"only {len(both)} complete trials have both {names[0]} and {names[1]}."
    for name in names:
        if len({trial.params[name] for trial in both}) < 2:
            return f"{name} has one value in the trials that have {' and '.join(names)}."
    return ""


def _contour(data: StudyData, names: list[str], index: int) -> Figure:
    import optuna
    from matplotlib import pyplot

    # Optuna draws with pyplot, which would open a window, and changes its style for good.
    pyplot.switch_backend("agg")
    with pyplot.rc_context(CONTOUR_STYLE), warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        axis: Any = optuna.visualization.matplotlib.plot_contour(
            data.copy(),
            params=names,
            target=lambda trial: trial.values[index],
            target_name=data.metrics[index],
        )
        drawing.adjust_contour(axis, data, index)
    figure: Figure = axis.figure
    pyplot.close(figure)
    return figure
