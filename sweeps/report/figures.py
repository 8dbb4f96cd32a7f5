"""The figures of a study as PNGs by Optuna, or the reason why one cannot be drawn."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sweeps.report.study_data import Importances, StudyData

if TYPE_CHECKING:
    import optuna

MIN_CONTOUR_TRIALS = 4
"""Fewest trials with both parameters from which a surface is drawn."""

SIZES = {"plot_slice": (5.4, 3.4)}
"""Inches, where they are not 8 by 5: Optuna's slices are half as wide as a figure each."""


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
    """Write ``<name>.png`` of every figure for this kind of study into an existing folder.

    The points of a list have no parameters, hence no figures; a grid has those that do not show
    the course of a search. A figure of an earlier call that can no longer be drawn is removed.
    """
    import optuna
    from matplotlib import pyplot

    # Optuna draws with pyplot, which would open a window, and changes its style for good.
    pyplot.switch_backend("agg")
    pictures = []
    for name, title, reason, plot, study, options in _figures(data, shares):
        path = folder / f"{name}.png"
        path.unlink(missing_ok=True)
        pictures.append(StudyFigure(name, title, None if reason else path, reason))
        if reason:
            continue
        style: Any = {"figure.figsize": SIZES.get(plot, (8.0, 5.0)), "figure.dpi": 110}
        style["figure.constrained_layout.use"] = True
        with pyplot.rc_context(style), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the remarks of the report say how uncertain it is
            axis = np.ravel(getattr(optuna.visualization.matplotlib, plot)(study(), **options))[0]
            axis.set_title("")
            axis.set_title("", loc="left")
            if plot == "plot_intermediate_values":  # a line for each of all trials
                axis.get_legend().remove()
            axis.figure.suptitle(f"{data.name}: {title}", fontsize=10)
            axis.figure.savefig(path)
            pyplot.close(axis.figure)
    return pictures


Make = Callable[[], "optuna.Study"]


def _figures(
    data: StudyData, shares: Importances
) -> Iterator[tuple[str, str, str, str, Make, dict[str, Any]]]:
    """File name, title, why it cannot be drawn or "", function of Optuna, study, options."""
    if data.kind == "list":
        return
    incomplete = "" if data.complete else "no trial is complete yet."
    no_values = incomplete or ("" if data.distributions else "the trials have no parameters.")
    for index, metric in enumerate(data.metrics):
        end = "" if len(data.metrics) == 1 else "_" + re.sub(r"\W+", "_", metric)
        study = partial(data.of_objective, index)
        target: dict[str, Any] = {"target_name": data.direction(index)}
        if data.kind == "search":
            title = f"{metric} by complete trial"
            yield f"history{end}", title, incomplete, "plot_optimization_history", study, target
        names = sorted(shares.shares, key=lambda name: -np.nan_to_num(shares.shares[name][index]))
        is_constant = len({trial.values[index] for trial in data.complete}) < 2
        reason = "" if names else shares.remark
        reason = reason or ("the objective has one value." if is_constant else "")
        params = {**target, "params": names}
        title = f"Importance of the parameters for {metric}"
        yield f"importances{end}", title, reason, "plot_param_importances", study, params
        yield (
            f"slices{end}",
            f"{metric} over each parameter",
            no_values,
            "plot_slice",
            study,
            target,
        )
        pair = names[:2]
        both = [trial.params for trial in data.complete if set(pair) <= set(trial.params)]
        is_varied = all(len({params[name] for params in both}) > 1 for name in pair)
        if reason or len(pair) < 2 or len(both) < MIN_CONTOUR_TRIALS or not is_varied:
            reason = f"two parameters need two values each in {MIN_CONTOUR_TRIALS} complete trials."
        params, title = {**target, "params": pair}, f"{metric} over two parameters"
        yield f"contour{end}", title, reason, "plot_contour", study, params
    if len(data.metrics) > 1:
        target = {"target_names": [data.direction(index) for index in range(len(data.metrics))]}
        reason = incomplete if len(data.metrics) < 4 else "Optuna draws up to three objectives."
        yield "pareto", "Pareto front", reason, "plot_pareto_front", data.in_memory, target
    elif data.kind == "search":
        is_reported = any(trial.intermediate_values for trial in data.trials)
        reason = "" if is_reported else "no trial has reported a value during training."
        title = "Validation during training"
        yield "intermediate", title, reason, "plot_intermediate_values", data.in_memory, {}
    lines = partial(data.of_objective, 0, with_others=True)
    target = {"target_name": data.direction(0)}
    title = "Parallel coordinates, dark lines are best"
    yield "parallel", title, no_values, "plot_parallel_coordinate", lines, target
