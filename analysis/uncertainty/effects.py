"""Effects of a two-level factorial design, with intervals over seeds and images.

An effect is the mean of the cells at the high level less the mean of those at the low level. An
interaction is half of the difference between the effects of one factor at the two levels of the
other. Every effect is a contrast of all cells, so that few seeds per cell suffice.

Source: Box, Hunter and Hunter, Statistics for Experimenters (2nd ed., 2005), chapters 5 and 6.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from analysis.uncertainty.blocks import Values
from analysis.uncertainty.contrasts import Evidence, combine
from analysis.uncertainty.estimates import Estimate, estimate_of
from analysis.uncertainty.intervals import Spread, holm

# Whose spread over seeds is the error: "cells", what is left of all cells after their means and
# those of the seeds (every cell is a training of its own, so all cells tell of the same noise);
# "effects", that of the effect itself over seeds (all cells are tests of one network).
Noise = Literal["cells", "effects"]


def estimate_effects(
    cells: Sequence[Evidence], contrasts: Values, noise: Noise, level: float = 0.95
) -> list[Estimate]:
    """Estimate effects with intervals over seeds and images.

    Args:
        cells: evidence of an outcome in C cells, with the same seeds and draws of images.
        contrasts: (E, C) signs, -1 or 1, each row with as many of one as of the other; a row of
            ones is the mean over all cells.
        noise: see `Noise`; a mean has that of its own.
        level: of the intervals.

    Returns:
        E estimates, whose p-values are corrected for E (Holm).

    Raises:
        ValueError: contrasts of another number of cells, or unbalanced ones.
    """
    count = len(cells)
    if contrasts.shape[1:] != (count,) or not set(contrasts.sum(1)) <= {0, count}:
        raise ValueError(f"contrasts: expected balanced rows of {count} signs.")
    values = np.array([cell.values for cell in cells]).T
    seeds = len(values)
    # Each seed is a block: initial weights and the order of the data are the same in all its cells.
    left = values - values.mean(0) - values.mean(1, keepdims=True) + values.mean()
    found: list[Estimate] = []
    for signs in contrasts:
        is_mean = bool((signs > 0).all())
        weights = signs / count if is_mean else 2.0 * signs / count
        evidence = combine(weights.tolist(), cells)
        if noise == "cells" and not is_mean and seeds > 1:
            freedom = (seeds - 1) * (count - 1)
            variance = float((left**2).sum()) / freedom * float((weights**2).sum()) / seeds
            evidence = replace(evidence, trainings=Spread(math.sqrt(variance), freedom))
        found.append(estimate_of(evidence, level))
    ps = holm([math.nan if estimate.both is None else estimate.p for estimate in found])
    return [replace(estimate, p_corrected=p) for estimate, p in zip(found, ps, strict=True)]
