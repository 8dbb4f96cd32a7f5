"""Multi-head, Fig. 3: gradients of entropy minimisation and of the maximum squares loss."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from analysis.figures import style
from analysis.figures.inputs import FigureInput

POINTS = 999
"""An odd number of points: 0.5, where both gradients vanish, is one of them."""


def gradient_curves(points: int = POINTS) -> tuple[NDArray[np.float64], ...]:
    """The two gradients of one pixel with two classes of probability p and 1 - p.

        entropy          E = -(p log p + (1 - p) log(1 - p)) / log 2,  |dE/dp| = |log2(p / (1 - p))|
        maximum squares  M = -(p^2 + (1 - p)^2) / 2,                   |dM/dp| = |2 p - 1|

    Source: Multi-head, Eqs. (1) and (2) with C = 2 and one pixel, constants as printed there. The
    paper that Fig. 3 is taken from (Chen et al., ICCV 2019) leaves out 1 / log 2 and 1 / 2, which
    multiplies the curves by 0.69 and by 2; the forms, linear against unbounded, are the same.

    Returns:
        p, |dE/dp| and |dM/dp|, (points,) each; p is spaced evenly inside (0, 1), without the ends,
        where the entropy's gradient is infinite.
    """
    p = np.arange(1, points + 1) / (points + 1)
    return p, np.abs(np.log2(p / (1 - p))), np.abs(2 * p - 1)


@style.styled
def make(given: FigureInput) -> Figure:
    """Both curves over the probability; analytic: nothing is `given`."""
    del given
    figure = style.new_figure(style.COLUMN, 2.3)
    axes = figure.subplots()
    probability, *curves = gradient_curves()
    for index, label in enumerate(("entropy minimisation", "maximum squares")):
        how = style.series_style(index) | {"marker": ""}
        axes.plot(probability, curves[index], label=label, **how)
    axes.set(xlim=(0, 1), xlabel="predicted probability", ylabel="gradient magnitude")
    axes.set_ylim(bottom=0, top=6)
    axes.legend(loc="upper center")
    return figure
