"""How sure a score or a difference is: resampling of images, spread over seeds, both together."""

from analysis.uncertainty.compare import Comparison, Difference, compare
from analysis.uncertainty.estimate import Estimate, estimate
from analysis.uncertainty.intervals import Interval
from analysis.uncertainty.settings import Resampling

__all__ = [
    "Comparison",
    "Difference",
    "Estimate",
    "Interval",
    "Resampling",
    "compare",
    "estimate",
]
