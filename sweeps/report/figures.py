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

import numpy as np

from sweeps.report import drawing
from sweeps.report.study_data import Importances, StudyData, used_parameters

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MIN_CONTOUR_TRIALS = 4
"""Fewest trials with both parameters from which a surface is drawn."""


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


def _figures(
    data: StudyData, shares: Importances
) -> Iterator[tuple[str, str, str, Callable[[], Figure]]]:
    """(file name, title, why it cannot be drawn or "", function) for this kind of study."""
    if data.kind == "list":
        return
    incomplete = "" if data.complete else "no trial is complete yet."
    if data.kind == "search":
        yield "history", "Objectives by trial", incomplete, partial(drawing.history, data)
        reason = ""
        if len(data.metrics) > 1:
            reason = "trials with several objectives report no values during training."
        elif not any(trial.intermediate_values for trial in data.trials):
            reason = "no trial has reported a value during training."
        make = partial(drawing.intermediate, data)
        yield "intermediate", "Validation during training", reason, make
    unimportant = "" if shares.shares else shares.remark
    bars = partial(drawing.importance_bars, data, shares)
    yield "importances", "Importance of the parameters", unimportant, bars
    if len(data.metrics) > 1:
        yield "pareto", "Pareto front", incomplete, partial(drawing.pareto, data)
    no_values = incomplete
    if data.complete and not used_parameters(data):
        no_values = "the complete trials have no parameters."
    lines = partial(by_optuna, data, "plot_parallel_coordinate", 0)
    yield "parallel", "Parallel coordinates, dark lines are best", no_values, lines
    for index, metric in enumerate(data.metrics):
        end = "" if len(data.metrics) == 1 else "_" + re.sub(r"\W+", "_", metric)
        slices = partial(by_optuna, data, "plot_slice", index)
        yield f"slices{end}", f"{metric} over each parameter", no_values, slices
        # The two most important parameters for this objective.
        names = sorted(shares.shares, key=lambda name: -shares.shares[name][index])[:2]
        reason = _without_contour(data, shares, names, index)
        contour = partial(by_optuna, data, "plot_contour", index, params=names)
        yield f"contour{end}", f"{metric} over two parameters", reason, contour


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


def by_optuna(data: StudyData, function: str, index: int, **options: Any) -> Figure:
    """A figure of `optuna.visualization.matplotlib` for one objective.

    Args:
        data: the study.
        function: its name.
        index: of the objective.
        options: of the function.
    """
    import optuna
    from matplotlib import pyplot

    # Optuna draws with pyplot, which would open a window, and changes its style for good.
    pyplot.switch_backend("agg")
    # Optuna's slices are half as wide as a figure each.
    size = (5.4, 3.4) if function == "plot_slice" else (8.0, 5.2)
    style: Any = {"figure.dpi": 110, "figure.constrained_layout.use": True, "figure.figsize": size}
    with pyplot.rc_context(style), warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        warnings.filterwarnings("ignore", "Attempting to set identical")  # of one trial
        draw_function = getattr(optuna.visualization.matplotlib, function)
        made = draw_function(
            data.of_objective(index, with_others=function == "plot_parallel_coordinate"),
            target_name=data.direction(index),
            **options,
        )
        figure: Figure = np.ravel(made)[0].figure
        np.ravel(made)[0].set_title("")
    pyplot.close(figure)
    return figure
