"""The figures of a study as PNGs, or a sentence why one cannot be drawn."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sweeps.report import drawing
from sweeps.report.axes import used_parameters
from sweeps.report.study_data import Importances, StudyData

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEWEST_FOR_CONTOUR = 4
"""Trials with both parameters from which a surface between them says anything."""


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
    """Write ``<name>.png`` of every figure that suits the study.

    A list has points without parameters, hence no figures of a search; a grid has those that do
    not speak of a search that goes on. A figure of an earlier call that cannot be drawn any more is
    removed.

    Args:
        data: the study.
        shares: `importances` of it.
        folder: where the files go; it exists.
    """
    pictures = []
    for name, title, make in _figures(data, shares):
        made = make()
        path = folder / f"{name}.png"
        if isinstance(made, str):
            path.unlink(missing_ok=True)
            pictures.append(StudyFigure(name, title, None, made))
        else:
            made.suptitle(f"{data.name}: {title}", fontsize=10)
            made.savefig(path)
            pictures.append(StudyFigure(name, title, path))
    return pictures


Made = tuple[str, str, Callable[[], "Figure | str"]]


def _figures(data: StudyData, shares: Importances) -> Iterator[Made]:
    """(file name, title, how it is made) of the figures that suit this kind of study."""
    if data.kind == "list":
        return
    if data.kind == "search":
        yield "history", "Objectives by trial", lambda: _history(data)
        yield "intermediate", "Validation while training", lambda: _intermediate(data)
    yield "importances", "Importance of the parameters", lambda: _importances(data, shares)
    if len(data.metrics) > 1:
        yield "pareto", "Pareto front", lambda: _pareto(data)
    yield "parallel", "Parallel coordinates, dark lines are best", lambda: _parallel(data)
    for index, metric in enumerate(data.metrics):
        end = "" if len(data.metrics) == 1 else "_" + re.sub(r"\W+", "_", metric)
        yield f"slices{end}", f"{metric} over each parameter", _bound(_slices, data, index)
        yield f"contour{end}", f"{metric} over two parameters", _contour_of(data, shares, index)


def _bound(
    make: Callable[[StudyData, int], Figure | str], data: StudyData, index: int
) -> Callable[[], Figure | str]:
    return lambda: make(data, index)


def _contour_of(data: StudyData, shares: Importances, index: int) -> Callable[[], Figure | str]:
    return lambda: _contour(data, shares, index)


def _history(data: StudyData) -> Figure | str:
    return drawing.history(data) if data.complete else _NONE_COMPLETE


_NONE_COMPLETE = "no trial is complete yet."


def _without_values(data: StudyData) -> str:
    """Why parameters cannot be drawn against objectives, or ""."""
    if not data.complete:
        return _NONE_COMPLETE
    has_parameters = bool(used_parameters(data))
    return "" if has_parameters else "the complete trials have no parameters."


def _intermediate(data: StudyData) -> Figure | str:
    if len(data.metrics) > 1:
        return "trials with several objectives report no values while they train."
    if not any(trial.intermediate_values for trial in data.trials):
        return "no trial has reported a value while it trained."
    return drawing.intermediate(data)


def _importances(data: StudyData, shares: Importances) -> Figure | str:
    return drawing.importance_bars(data, shares) if shares.shares else shares.remark


def _pareto(data: StudyData) -> Figure | str:
    return drawing.pareto(data) if data.complete else _NONE_COMPLETE


def _parallel(data: StudyData) -> Figure | str:
    return _without_values(data) or drawing.parallel(data)


def _slices(data: StudyData, index: int) -> Figure | str:
    return _without_values(data) or drawing.slices(data, index)


def _contour(data: StudyData, shares: Importances, index: int) -> Figure | str:
    """The surface over the two most important parameters of this objective."""
    if not shares.shares:
        return f"it shows the two most important parameters: {shares.remark}"
    if len(shares.shares) < 2:
        return "only one parameter took two values."
    if math.isnan(next(iter(shares.shares.values()))[index]):
        return f"{data.metrics[index]} has the same value in all trials."
    names = sorted(shares.shares, key=lambda name: -shares.shares[name][index])[:2]
    both = [trial for trial in data.complete if all(name in trial.params for name in names)]
    if len(both) < FEWEST_FOR_CONTOUR:
        return f"only {len(both)} complete trials have both {names[0]} and {names[1]}."
    for name in names:
        if len({trial.params[name] for trial in both}) < 2:
            return f"{name} has one value in the trials that have {' and '.join(names)}."
    return _optunas_contour(data, names, index)


def _optunas_contour(data: StudyData, names: list[str], index: int) -> Figure:
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
