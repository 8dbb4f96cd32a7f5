"""Which of some points is the best: a race on paired seeds that may be looked at after every run.

Every pair of points is compared. A point that is shown to be worse than another one gets no more
seeds, and the last point that is left is the best.

Source: Maron and Moore, "Hoeffding Races", NIPS 6 (1993); Birattari et al., "A Racing Algorithm for
Configuring Metaheuristics", GECCO 2002. Here each pair has a confidence sequence of paired
differences (`analysis.uncertainty.verdicts.AnyTime`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import count
from statistics import fmean

from analysis.uncertainty import Resampling
from analysis.uncertainty.contrasts import Resampler, Term
from analysis.uncertainty.sequence import half_width
from analysis.uncertainty.verdicts import AnyTime, Verdict, decide
from rgbt.runs.result import RunResult
from sweeps.point import Outcome
from sweeps.table.claim import HIGHER, LOWER
from sweeps.verdicts.judge import RESAMPLES, CellRunId
from sweeps.verdicts.loaded_counts import LoadedCounts

ERROR_RATE = 0.025
"""Bound of the share of searches whose best point is called worse than another one."""


def level_of(points: int) -> float:
    """Level of the interval of every pair of `points` points.

    The best point is compared with each other one, and each comparison may call it worse: one-sided
    error rates that add up to `ERROR_RATE`.
    """
    return 1 - 2 * ERROR_RATE / (points - 1)


def fewest_seeds(points: int) -> int:
    """Smallest number of seeds that can decide anything about `points` points, two or more."""
    alpha = (1 - level_of(points)) / 2
    return next(n for n in count(2) if math.isfinite(half_width(1.0, n, alpha)))


Finished = Mapping[str, Mapping[int, RunResult]]
"""Label -> seed -> finished run."""


@dataclass(frozen=True, kw_only=True)
class ScoreFile:
    """Where the runs of a point have the score that is compared.

    Attributes:
        metric: a name of `rgbt.metrics.named`.
        path: of the counts, relative to the run folder.
    """

    metric: str
    path: str


@dataclass(frozen=True, kw_only=True)
class Standing:
    """A point in the race.

    Attributes:
        seeds: of its finished runs.
        worse_than: label of a point that it is shown to be worse than, or "".
        difference: verdict on "it is worse than the leader"; None for the leader, and where no
            seeds are common.
        reason: why there is no difference, or why its runs are incomplete; one sentence, or "".
    """

    label: str
    seeds: tuple[int, ...]
    worse_than: str = ""
    difference: Verdict | None = None
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class Race:
    """The points as they stand.

    Attributes:
        standings: in the order of the points.
        leader: label of the best by the mean of the further seeds, among those that are not shown
            to be worse; "" where no run has finished.
        level: of each interval of a difference.
    """

    standings: tuple[Standing, ...]
    leader: str
    level: float

    @property
    def open(self) -> list[str]:
        """Labels of the points that are not shown to be worse than another one."""
        return [each.label for each in self.standings if not each.worse_than]

    @property
    def is_decided(self) -> bool:
        """Whether the leader is shown to be the best."""
        return self.open == [self.leader]

    @property
    def contenders(self) -> list[Verdict]:
        """Differences to the leader of the points that are not shown to be worse."""
        left = (each.difference for each in self.standings if not each.worse_than)
        return [difference for difference in left if difference is not None]

    @property
    def obstacle(self) -> str:
        """Why no number of seeds decides it, in a sentence, or ""."""
        fewest = fewest_seeds(len(self.standings))
        enough = [each for each in self.contenders if each.seeds >= fewest]
        return next((each.reason for each in enough if each.interval is None), "")


@dataclass
class BestPointJudge:
    """Compares points by one score; keeps counts and resampled scores between calls.

    Attributes:
        files: by the label of the point, two or more.
        maximize: whether a higher score is better.
        settings: of the resampling of images.
    """

    files: Mapping[str, ScoreFile]
    maximize: bool
    settings: Resampling = field(default_factory=lambda: Resampling(resamples=RESAMPLES))

    def __post_init__(self) -> None:
        self._resampler = Resampler(self.settings)
        self._counts = LoadedCounts()
        self._rule = AnyTime(level=level_of(len(self.files)))

    def race(self, runs: Mapping[CellRunId, Outcome]) -> Race:
        """The standings by the finished ones of `runs`.

        Raises:
            InputError: counts that are missing or damaged.
        """
        finished: Finished = {
            label: {
                seed: run.results[0]
                for (each, seed), run in sorted(runs.items())
                if each == label and run.state == "finished" and run.results
            }
            for label in self.files
        }
        worse = self._worse(finished)
        leader = self._leader(finished, worse)
        failed = {label: run.reason for (label, _), run in runs.items() if run.state == "failed"}
        standings = []
        for label, own in finished.items():
            found = None if label == leader else self._compared(label, leader, finished)
            reason = f"a run failed: {failed[label]}" if label in failed else ""
            # Of two points that it is worse than, the leader is named.
            beaten = leader if found is not None and found.kind == "holds" else worse.get(label, "")
            standings.append(
                Standing(
                    label=label,
                    seeds=tuple(own),
                    worse_than=beaten,
                    difference=found,
                    reason=reason,
                )
            )
        return Race(standings=tuple(standings), leader=leader, level=self._rule.level)

    def _worse(self, finished: Finished) -> dict[str, str]:
        """Label of a point that is shown to be worse -> label of one that is better."""
        worse: dict[str, str] = {}
        labels = list(finished)
        for place, label in enumerate(labels):
            for other in labels[place + 1 :]:
                found = self._compared(label, other, finished)
                if found is not None and found.kind == "holds":
                    worse.setdefault(label, other)
                elif found is not None and found.kind == "contradicted":
                    worse.setdefault(other, label)
        return worse

    def _leader(self, finished: Finished, worse: Mapping[str, str]) -> str:
        means = {label: fmean(self._score(label, own)) for label, own in finished.items() if own}
        left = {label: mean for label, mean in means.items() if label not in worse} or means
        if not left:
            return ""
        return (max if self.maximize else min)(left, key=lambda label: left[label])

    def _score(self, label: str, own: Mapping[int, RunResult]) -> tuple[float, ...]:
        return self._resampler.evidence([self._term(1.0, label, own)]).values

    def _compared(self, label: str, other: str, finished: Finished) -> Verdict | None:
        """The verdict on "`label` is worse than `other`"; None without a common seed."""
        if not finished.get(label, {}).keys() & finished.get(other, {}).keys():
            return None
        pair = ((1.0, label), (-1.0, other))
        terms = [self._term(weight, each, finished[each]) for weight, each in pair]
        wanted = LOWER if self.maximize else HIGHER
        return decide([self._resampler.evidence(terms)], wanted, self._rule, "all")

    def _term(self, weight: float, label: str, own: Mapping[int, RunResult]) -> Term:
        file = self.files[label]
        return Term(
            weight=weight,
            metric=file.metric,
            counts={seed: self._counts.of(run, file.path) for seed, run in own.items()},
            keys={seed: f"{run.key}/{file.path}" for seed, run in own.items()},
        )
