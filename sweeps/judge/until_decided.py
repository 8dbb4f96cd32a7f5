"""Adds paired seeds to the rows of undecided claims: ``seeds=until_decided``.

Any number of drivers may do so at the same time: each looks at the finished runs by itself, and a
run that two of them want is done once. The rule must be valid at any time it is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import count, islice

from sweeps.judge.contrasts import contrasts_of
from sweeps.judge.judged_claim import JudgedClaim
from sweeps.judge.judged_table import JudgedTable
from sweeps.plan.request import RowSeed
from sweeps.point import Outcome, Point

# Seeds of every row before the claims are judged for the first time: with fewer, an interval that
# is valid at any time is infinite.
START = 4

# Seeds after which a claim that would need more than 1,000 of them gets no more.
HOPELESS = 8


@dataclass
class SeedsUntilDecided:
    """The further points of a table.

    Attributes:
        judged: the table, without runs.
        max_seeds: most seeds of a row, beside those that the table declares.
        external: runs of rows that are not trained.
    """

    judged: JudgedTable
    max_seeds: int
    external: Mapping[RowSeed, Outcome] = field(default_factory=dict)
    _seen: frozenset[RowSeed] | None = field(default=None, init=False)

    def __call__(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """Return the next seed of the rows of every undecided claim; [] where nothing has changed.

        It is the lowest one that some of these rows lack, for each of them. They get it while at
        most one of their seeds is unfinished: no worker is idle, and few runs are made that turn
        out to be unnecessary. Rows of a claim with a failed or a missing run get no seeds.
        `outcomes` are those of all points until now.
        """
        request = self.judged.request
        runs = request.runs(outcomes)
        finished = frozenset(run for run, outcome in runs.items() if outcome.state == "finished")
        if finished == self._seen:
            return []
        self._seen = finished
        wanted: dict[RowSeed, None] = {}
        for judged in replace(self.judged, runs={**runs, **self.external}).claims:
            if _is_open(judged):
                wanted |= dict.fromkeys(self._next_runs(judged, runs))
        known = {outcome.point.overrides for outcome in outcomes}
        points = request.points(list(wanted))
        return [point for point in points if point.overrides not in known]

    def _next_runs(self, judged: JudgedClaim, runs: Mapping[RowSeed, Outcome]) -> list[RowSeed]:
        """The runs of the lowest seed that a row of an open claim lacks; [] where it must wait."""
        request = self.judged.request
        named: set[str] = set()
        for contrast in contrasts_of(judged.claim, request.table):
            named |= contrast.rows
        labels = [row.label for row in request.trained_rows if row.label in named]
        unfinished: set[int] = set()
        for (label, seed), outcome in runs.items():
            if label in labels and outcome.state in ("failed", "missing"):
                return []
            if label in labels and outcome.state != "finished":
                unfinished.add(seed)
        if len(unfinished) > 1:
            return []
        explored = (seed for seed in count() if seed not in request.table.confirm)
        for seed in islice(explored, self.max_seeds):
            lacking = [(label, seed) for label in labels if (label, seed) not in runs]
            if lacking:
                return lacking
        return []


def _is_open(judged: JudgedClaim) -> bool:
    """Whether further seeds may decide a claim.

    Not without scores of every contrast or with too few images for an interval, and not where the
    estimate of `HOPELESS` seeds says that no affordable number of seeds decides it. To stop for
    such a reason cannot make a verdict wrong.
    """
    verdict = judged.exploration
    is_open = not judged.is_level or judged.of_paper
    if verdict is None or verdict.kind != "undecided" or not (judged.complete and is_open):
        return False
    if verdict.seeds >= START and verdict.interval is None:
        return False
    return verdict.seeds < HOPELESS or math.isfinite(verdict.seeds_needed)
