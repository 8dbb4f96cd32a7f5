"""All figures by name, as the modules that make them declare them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from analysis.figures import method_figures, paper_figures
from analysis.figures.figure_spec import FigureSpec
from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError, check_choice, nearest

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FIGURES = {
    spec.name: spec
    for module in (paper_figures, method_figures)
    for spec in vars(module).values()
    if isinstance(spec, FigureSpec)
}


def make(
    figure: str, values: dict[str, Any], overrides: list[str]
) -> tuple[Figure, Mapping[str, str]]:
    """The figure called `figure`, and its numbers as text by the ending of their file.

    Args:
        figure: a key of `FIGURES`.
        values: key -> value of the options that were given.
        overrides: other ``key=value`` arguments.

    Raises:
        InputError: no such figure, a key that has no effect on it, or input that is missing or bad.
    """
    check_choice("figure", figure, FIGURES)
    entry = FIGURES[figure]
    words = [word.lstrip("+~").partition("=")[0] for word in overrides]
    idle = [key for key in values if key not in entry.keys]
    idle += [key for key in words if key.split(".")[0] not in entry.groups or key in entry.idle]
    if idle:
        known = ("figure", "out", *entry.keys, *entry.groups)
        raise InputError(
            f"'{idle[0]}' has no effect on figure={figure}; {nearest(idle[0], known)}."
        )
    given = FigureInput(figure, values, tuple(overrides), entry.metric)
    if not given.has_dataset:
        given.refuse([key for key in words if key.startswith("dataset.")], "dataset=...")
    return entry.make(given), {} if entry.numbers is None else entry.numbers(given)
