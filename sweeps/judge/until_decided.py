"""Adds paired seeds to the rows of undecided claims: ``seeds=until_decided``.

Any number of drivers may do so at the same time: each looks at the finished runs by itself, and a
run that two of them want is done once. The rule must be valid at any time it is looked at.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sweeps.judge.judged_table import CellRunId, JudgedClaim, TableJudge, contrasts_of
from sweeps.plan.request import TableRequest
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
        judge: with a rule that is valid at any time.
        max_seeds: most seeds of a row.
        external: runs of rows that are not trained.
    """

    request: TableRequest
    judge: TableJudge
    max_seeds: int
    external: Mapping[CellRunId, Outcome] = field(default_factory=dict)
    _seen: frozenset[CellRunId] | None = field(default=None, init=False)

    def __call__(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """The next seed of the rows of every undecided claim; [] where nothing has changed.

        It is the lowest one that some of these rows lack, for each of them. They get it while at
        most one of their seeds is unfinished: no worker is idle, and few runs are made that turn
        out to be unnecessary. Rows of a claim with a failed run get no seeds.
        `outcomes` are those of all points until now.
        """
        runs = self.request.runs(outcomes)
        finished = frozenset(each for each, run in runs.items() if run.state == "finished")
        if finished == self._seen:
            return []
        self._seen = finished
        wanted: dict[CellRunId, None] = {}
        for judged in self.judge.claims({**runs, **self.external}):
            contrasts = contrasts_of(judged.claim, self.request.table)
            named = {label for each in contrasts for label in each.rows}
            labels = [row.label for row in self.request.trained_rows if row.label in named]
            own = {each: run for each, run in runs.items() if each[0] in labels}
            unfinished = {seed for (_, seed), run in own.items() if run.state != "finished"}
            is_failed = any(run.state == "failed" for run in own.values())
            if is_failed or len(unfinished) > 1 or not _is_open(judged):
                continue
            every = ([(label, seed) for label in labels] for seed in range(self.max_seeds))
            lacking = ([each for each in row if each not in own] for row in every)
            wanted |= dict.fromkeys(next(filter(None, lacking), []))
        have = {outcome.point.overrides for outcome in outcomes}
        return [each for each in self.request.points(list(wanted)) if each.overrides not in have]


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
