"""A picture of degradations: one line each, the clean pair and every severity of the ladder."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rgbt.corruptions.corruption import Degradation
from rgbt.corruptions.dataset import Degraded
from rgbt.dataset import LabelledDataset
from rgbt.types import Sample

CELL = 2.4
"""Width in inches of a pair: RGB left, thermal right."""


@dataclass(frozen=True)
class Line:
    """One degradation.

    Attributes:
        title: its title.
        unit: of its severities.
        pairs: (severity, sample), the clean one (0) first.
    """

    title: str
    unit: str
    pairs: tuple[tuple[float, Sample], ...]


def sheet(
    source: LabelledDataset, kinds: Iterable[Degradation], name: str, split: str, seed: int = 0
) -> tuple[Line, ...]:
    """One sample under every severity of every degradation.

    Args:
        source: the data set.
        kinds: degradations.
        name: of the sample.
        split: that it is of.
        seed: of what is drawn.
    """
    lines = []
    for kind in kinds:
        pairs = []
        for severity in (0.0, *kind.severities):
            seen = Degraded(source, kind, severity, split=split, seed=seed)
            pairs.append((severity, seen.read(name)))
        lines.append(Line(kind.title, kind.unit, tuple(pairs)))
    return tuple(lines)


def side_by_side(sample: Sample) -> NDArray[np.uint8]:
    """(H, 2 W, 3): RGB left, thermal right."""
    return np.hstack([sample.rgb, np.repeat(sample.thermal[..., None], 3, axis=2)])


def draw(lines: tuple[Line, ...]) -> Figure:
    """The picture, drawn without a display."""
    columns = max(len(line.pairs) for line in lines)
    height, width = lines[0].pairs[0][1].thermal.shape
    cell_height = CELL * height / (2 * width) + 0.2
    figure = Figure(figsize=(CELL * columns, cell_height * len(lines)))
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.03, wspace=0.01, hspace=0.01)
    grid = figure.subplots(len(lines), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for row, line in zip(grid, lines, strict=True):
        for axes, (severity, sample) in zip(row, line.pairs, strict=False):
            axes.imshow(side_by_side(sample))
            axes.set_title(_said(line, severity), fontsize=7, loc="left", pad=2)
    return figure


def _said(line: Line, severity: float) -> str:
    if severity == 0:
        return line.title
    return f"{severity:g} {line.unit}" if line.unit else ""
