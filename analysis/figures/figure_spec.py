"""How a figure is declared, beside the function that makes it: its name, input and keys."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from analysis.figures.inputs import FigureInput

if TYPE_CHECKING:
    from matplotlib.figure import Figure

STATISTICS = "statistics= (of analysis.spatial) or dataset="
SPATIAL = ("statistics", "split")
RUNS = "runs= (run, group or counts, with labels: label:run)"
OF_RUNS = ("runs", "runs_dir", "split", "absent")
DATASET_AND_METRIC = ("dataset", "metric")


@dataclass(frozen=True, kw_only=True)
class FigureSpec:
    """One figure.

    Attributes:
        name: as in ``figure=``.
        shows: one line.
        needs: what must be given, in words.
        keys: keys that take effect, beside ``figure`` and ``out``.
        groups: groups of the configuration that take effect.
        metric: the partition unless ``metric=`` is given.
        idle: keys of the configuration below `groups` that take no effect nevertheless.
        numbers: what it shows as text, written beside it by the ending of the file; None: nothing.
    """

    name: str
    shows: str
    needs: str
    keys: tuple[str, ...] = ()
    groups: tuple[str, ...] = ()
    make: Callable[[FigureInput], Figure]
    metric: str = "ring5"
    idle: tuple[str, ...] = ("metric.absent",)
    numbers: Callable[[FigureInput], Mapping[str, str]] | None = None


def figure(name: str, shows: str, needs: str, **others: Any) -> Callable[..., FigureSpec]:
    """Declare the decorated function as a figure; see `FigureSpec`."""
    return lambda make: FigureSpec(name=name, shows=shows, needs=needs, make=make, **others)
