"""A picture of corruptions: one line each, the clean pair and every severity of the ladder."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from rgbt.corruptions.corruption import Corruption
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.corrupted_dataset import CorruptedDataset
from rgbt.types import Sample

CELL = 2.4
"""Width in inches of a pair: RGB left, thermal right."""


def sheet(
    source: LabelledDataset, kinds: Sequence[Corruption], name: str, split: str, seed: int = 0
) -> list[list[tuple[str, Sample]]]:
    """The sample `name` with captions for every corruption: clean, then under every severity."""
    lines = []
    for kind in kinds:
        pairs = [(kind.title, source.read(name))]
        for severity in kind.severities:
            caption = f"{severity:g} {kind.unit}" if kind.unit else ""
            seen = CorruptedDataset(source, kind, severity, split=split, seed=seed)
            pairs.append((caption, seen.read(name)))
        lines.append(pairs)
    return lines


def side_by_side(sample: Sample) -> NDArray[np.uint8]:
    """(H, 2 W, 3): RGB left, thermal right."""
    return np.hstack([sample.rgb, np.repeat(sample.thermal[..., None], 3, axis=2)])


def draw(lines: Sequence[list[tuple[str, Sample]]]) -> Figure:
    """The picture, drawn without a display."""
    columns = max(map(len, lines))
    height, width = lines[0][0][1].thermal.shape
    cell_height = CELL * height / (2 * width) + 0.2
    figure = Figure(figsize=(CELL * columns, cell_height * len(lines)))
    figure.set_layout_engine("constrained", w_pad=0.01, h_pad=0.03, wspace=0.01, hspace=0.01)
    grid = figure.subplots(len(lines), columns, squeeze=False)
    for axes in grid.flat:
        axes.set_axis_off()
    for row, line in zip(grid, lines, strict=True):
        for axes, (caption, sample) in zip(row, line, strict=False):
            axes.imshow(side_by_side(sample))
            axes.set_title(caption, fontsize=7, loc="left", pad=2)
    return figure
