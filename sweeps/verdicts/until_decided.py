"""Adds paired seeds to the rows of undecided claims: ``seeds=until_decided``.

Any number of drivers may do so at the same time: each looks at the finished runs by itself, and a
run that two of them want is done once. The rule must be valid at any time it is looked at.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from sweeps.point import Point
from sweeps.table.cells import CellRun
from sweeps.table.request import TableRequest
from sweeps.verdicts.contrasts import contrasts_of
from sweeps.verdicts.judge import CellRunId, JudgedClaim, TableJudge
from sweeps.worker.trial_sources import Outcome

START = 3
"""Seeds of every row before the claims are judged for the first time."""


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
    external: Mapping[CellRunId, CellRun] = field(default_factory=dict)
    _seen: frozenset[CellRunId] | None = field(default=None, init=False)

    def __call__(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """The next seed of the rows of every undecided claim; [] where nothing has changed.

        Called again before a further run is finished, it adds nothing: claims are never more than
        one seed ahead of what is known.

        Args:
            outcomes: of all points until now.
        """
        runs = self.request.runs(outcomes)
        finished = frozenset(each for each, run in runs.items() if run.state == "finished")
        if finished == self._seen:
            return []
        self._seen = finished
        failed = {label for (label, _), run in runs.items() if run.state == "failed"}
        planned = {row.label: set[int]() for row in self.request.trained_rows}
        for label, seed in runs:
            planned[label].add(seed)
        wanted: dict[CellRunId, None] = {}
        judged = self.judge.claims({**runs, **self.external})
        for each in filter(_is_open, judged):
            labels = self._trained(each)
            if labels and not failed.intersection(labels):
                wanted |= dict.fromkeys(self._next(labels, planned))
        have = {outcome.point.overrides for outcome in outcomes}
        return [each for each in self.request.points(list(wanted)) if each.overrides not in have]

    def most_runs(self) -> list[Point]:
        """Every point that may be run: `max_seeds` of rows of claims, `START` of others."""
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

    def _trained(self, judged: JudgedClaim) -> list[str]:
        """Labels of the trained rows of a claim."""
        contrasts = contrasts_of(judged.claim, self.request.table)
        named = {label for each in contrasts for label in each.rows}
        return [row.label for row in self.request.trained_rows if row.label in named]

    def _next(self, labels: Sequence[str], planned: Mapping[str, set[int]]) -> list[CellRunId]:
        """The lowest seed that some of the rows lack, for each of them."""
        for seed in range(self.max_seeds):
            lacking = [label for label in labels if seed not in planned[label]]
            if lacking:
                return [(label, seed) for label in lacking]
        return []


def _is_open(judged: JudgedClaim) -> bool:
    """Whether further seeds may decide a claim: there are scores, and no rows are missing."""
    return judged.word == "undecided" and not judged.missing
