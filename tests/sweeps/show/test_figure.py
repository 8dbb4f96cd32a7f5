"""The figure of a table: values by hand."""

from __future__ import annotations

import numpy as np

from sweeps.show.figure import SHIFT, figure_of
from tests.sweeps.tabled import Made


def test_ours_are_above_published_values() -> None:
    figure = figure_of(Made({"a": ((40, 50), 48.0), "b": ((60, 70), None)}).scored())
    (axes,) = figure.axes
    assert axes.get_xlabel() == "acc"
    assert [text.get_text() for text in axes.get_yticklabels()] == ["a", "b"]
    ours, theirs = axes.containers
    assert ours[0].get_xydata().tolist() == [[45.0, 0.0], [65.0, 1.0]]
    assert np.array_equal(theirs[0].get_xdata(), [48.0, np.nan], equal_nan=True)
    assert theirs[0].get_ydata()[0] == SHIFT
