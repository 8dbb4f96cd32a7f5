"""Multi-head, Fig. 3: gradients of entropy minimisation and of the maximum squares loss."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from analysis.figures.style import COLUMN, new_figure, series_style, styled

if TYPE_CHECKING:
    from matplotlib.figure import Figure

POINTS = 999
"""An odd number of points: 0.5, where both gradients vanish, is one of them."""


@dataclass(frozen=True)
class GradientCurves:
    """Magnitude of the derivative by the probability of one of two classes.

    Attributes:
        probability: (M,) in (0, 1).
        entropy: (M,).
        maximum_squares: (M,).
    """

    probability: NDArray[np.float64]
    entropy: NDArray[np.float64]
    maximum_squares: NDArray[np.float64]


def gradient_curves(points: int = POINTS) -> GradientCurves:
    """The two gradients of one pixel with two classes of probability p and 1 - p.

        entropy          E = -(p log p + (1 - p) log(1 - p)) / log 2,  |dE/dp| = |log2(p / (1 - p))|
        maximum squares  M = -(p^2 + (1 - p)^2) / 2,                   |dM/dp| = |2 p - 1|

    Source: Multi-head, Eqs. (1) and (2) with C = 2 and one pixel, constants as printed there. The
    paper that Fig. 3 is taken from (Chen et al., ICCV 2019) leaves out 1 / log 2 and 1 / 2, which
    multiplies the curves by 0.69 and by 2; the forms, linear against unbounded, are the same.

    Args:
        points: M, spaced evenly inside (0, 1); the ends are left out, where the entropy's gradient
            is infinite.
    """
    p = np.arange(1, points + 1) / (points + 1)
    return GradientCurves(p, np.abs(np.log2(p / (1 - p))), np.abs(2 * p - 1))


@styled
def draw(curves: GradientCurves) -> Figure:
    """Both curves over the probability."""
    figure = new_figure(COLUMN, 2.3)
    axes = figure.subplots()
    named = (("entropy minimisation", curves.entropy), ("maximum squares", curves.maximum_squares))
    for index, (label, values) in enumerate(named):
        style = series_style(index) | {"marker": ""}
        axes.plot(curves.probability, values, label=label, **style)
    axes.set(xlim=(0, 1), xlabel="predicted probability", ylabel="gradient magnitude")
    axes.set_ylim(bottom=0, top=6)
    axes.legend(loc="upper center")
    return figure
