"""How sure a score or a difference is: resampling of images, spread over seeds, both together."""

from analysis.uncertainty.blocks import Resampling
from analysis.uncertainty.estimates import (
    Comparison,
    Difference,
    Estimate,
    compare,
    estimate,
    sentence,
)
from analysis.uncertainty.intervals import Interval

__all__ = [
    "Comparison",
    "Difference",
    "Estimate",
    "Interval",
    "Resampling",
    "compare",
    "estimate",
    "sentence",
]
