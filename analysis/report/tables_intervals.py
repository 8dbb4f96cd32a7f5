"""Intervals of table cells: every set of runs is resampled once, for all of its scores."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from analysis.report.data import Uncertainty
from analysis.report.runs import ReportRun
from analysis.uncertainty import Interval, Resampling, compare, estimate
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent

Track = Callable[[Sequence[Any], str], Iterable[Any]]
"""Goes over a sequence and shows how far it is: (sequence, what is done)."""


@dataclass(frozen=True)
class CountsSource:
    """Counts that scores are taken from.

    Attributes:
        keys: of the runs, one per seed.
        paths: of the counts in each run; two: the first less the
            second.
        absent: how a class without pixels scores; None: as the counts say.
    """

    keys: tuple[str, ...]
    paths: tuple[str, ...]
    absent: Absent | None


@dataclass(frozen=True)
class CellInterval:
    """An interval, and what it is over; without one, why there is none."""

    interval: Interval | None
    covers: Uncertainty
    reason: str = ""


@dataclass
class Intervals:
    """What is requested, then what was found.

    Attributes:
        requested: source -> metrics.
        found: the intervals by source and metric, after `compute`.
    """

    runs: Mapping[str, ReportRun]
    requested: dict[CountsSource, dict[str, None]] = field(default_factory=dict)
    found: dict[tuple[CountsSource, str], CellInterval] = field(default_factory=dict)

    def request(self, source: CountsSource, metric: str) -> None:
        """Request the interval of a score."""
        self.requested.setdefault(source, {})[metric] = None

    def compute(self, resamples: int, track: Track) -> None:
        """Find every interval that was requested."""
        for source in track(list(self.requested), "intervals"):
            metrics = tuple(self.requested[source])
            settings = Resampling(resamples=resamples, absent=source.absent)
            try:
                counts = [self._counts(source.keys, path) for path in source.paths]
                found = _resampled(counts, metrics, settings)
            except InputError as error:
                found = dict.fromkeys(metrics, CellInterval(None, "none", str(error)))
            self.found |= {(source, metric): each for metric, each in found.items()}

    def _counts(self, keys: Sequence[str], path: str) -> list[Counts]:
        return [self.runs[key].counts(path) for key in keys]


def _resampled(
    counts: Sequence[Sequence[Counts]], metrics: Sequence[str], settings: Resampling
) -> dict[str, CellInterval]:
    """Intervals of scores, or of the difference of two evaluations of the same runs."""
    if len(counts) == 1:
        estimates = estimate(counts[0], metrics, settings)
        return {
            metric: _covering(each.images, each.both, each.said)
            for metric, each in estimates.items()
        }
    first, second = counts
    compared = compare(second, first, metrics, settings, paired=True)
    return {
        each.metric: _covering(each.images, each.both, compared.said)
        for each in compared.differences
    }


def _covering(images: Interval | None, both: Interval | None, said: str) -> CellInterval:
    if both is not None:
        return CellInterval(both, "images and seeds")
    if images is not None:
        return CellInterval(images, "images")
    return CellInterval(None, "none", f"no interval: {said} are too few.")
