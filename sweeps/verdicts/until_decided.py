"""Adds paired seeds to the rows of undecided claims: ``seeds=until_decided``.

Any number of drivers may do so at the same time: each looks at the finished runs by itself, and a
run that two of them want is done once. The rule must be valid at any time it is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field

from sweeps.point import Outcome, Point
from sweeps.table.request import TableRequest
from sweeps.verdicts.contrasts import contrasts_of
from sweeps.verdicts.judge import CellRunId, JudgedClaim, TableJudge

START = 4
"""Seeds of every row before the claims are judged for the first time: with fewer, an interval that
is valid at any time is infinite."""

HOPELESS = 8
"""Seeds after which a claim that would need more than 1,000 of them gets no more."""


@dataclass
class PairedSeeds:
    """Chooses the next seed of rows that are compared with each other.

    Attributes:
        seeds: those that a row may get, in order.
    """

    seeds: Sequence[int]
    _seen: frozenset[CellRunId] | None = field(default=None, init=False)

    def further(
        self,
        runs: Mapping[CellRunId, Outcome],
        open_groups: Callable[[], Iterable[Sequence[str]]],
    ) -> list[CellRunId]:
        """The lowest seed that some rows of a group lack, for each of them; of every open group.

        A group gets a seed while at most one of its seeds is unfinished: no worker is idle, and
        few runs are made that turn out to be unnecessary. A group with a failed run gets no seeds.

        Args:
            runs: all that are planned, in any state.
            open_groups: labels of rows that need further seeds; called if a run has finished since
                the last call.
        """
        finished = frozenset(each for each, run in runs.items() if run.state == "finished")
        if finished == self._seen:
            return []
        self._seen = finished
        failed = {label for (label, _), run in runs.items() if run.state == "failed"}
        groups = [labels for labels in open_groups() if not failed.intersection(labels)]
        wanted = {each: None for labels in groups for each in self._next(labels, runs)}
        return list(wanted)

    def _next(self, labels: Sequence[str], runs: Mapping[CellRunId, Outcome]) -> list[CellRunId]:
        own = {each: run for each, run in runs.items() if each[0] in labels}
        if len({seed for (_, seed), run in own.items() if run.state != "finished"}) > 1:
            return []
        for seed in self.seeds:
            lacking = [(label, seed) for label in labels if (label, seed) not in own]
            if lacking:
                return lacking
        return []


@dataclass
class SeedsUntilDecided:
    """The further points of a table.

    Attributes:
        judge: with a rule that is valid at any time.
        max_seeds: most seeds of a row.
        external: runs of rows that are not trained.
    """

    request: TableRequest
    judge: TableJudge
    max_seeds: int
    external: Mapping[CellRunId, Outcome] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._seeds = PairedSeeds(range(self.max_seeds))

    def __call__(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """The next seed of the rows of every undecided claim; [] where nothing has changed.

        Args:
            outcomes: of all points until now.
        """
        runs = self.request.runs(outcomes)
        wanted = self._seeds.further(runs, lambda: self._open(runs))
        have = {outcome.point.overrides for outcome in outcomes}
        return [each for each in self.request.points(wanted) if each.overrides not in have]

    def most_runs(self) -> list[Point]:
        """Every point that may be run: `max_seeds` of rows of claims, `START` of others."""
        if not self.request.row_seeds():
            return []
        named = {
            label
            for claim in self.request.table.claims
            for each in contrasts_of(claim, self.request.table)
            for label in each.rows
        }
        return self.request.points(
            [
                (row.label, seed)
                for row in self.request.trained_rows
                for seed in range(self.max_seeds if row.label in named else START)
            ]
        )

    def _open(self, runs: Mapping[CellRunId, Outcome]) -> list[list[str]]:
        """Labels of the trained rows of every claim that further seeds may decide."""
        judged = self.judge.claims({**runs, **self.external})
        return [labels for each in judged if _is_open(each) and (labels := self._trained(each))]

    def _trained(self, judged: JudgedClaim) -> list[str]:
        """Labels of the trained rows of a claim."""
        contrasts = contrasts_of(judged.claim, self.request.table)
        named = {label for each in contrasts for label in each.rows}
        return [row.label for row in self.request.trained_rows if row.label in named]


def _is_open(judged: JudgedClaim) -> bool:
    """Whether further seeds may decide a claim.

    Not without scores of every contrast or with too few images for an interval, and not where the
    estimate of `HOPELESS` seeds says that no affordable number of seeds decides it. To stop for
    such a reason cannot make a verdict wrong.
    """
    found = judged.verdict
    if found is None or judged.word != "undecided" or not judged.complete:
        return False
    if found.seeds >= START and found.interval is None:
        return False
    return found.seeds < HOPELESS or math.isfinite(found.seeds_needed)
