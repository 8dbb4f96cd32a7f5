"""Confirms the best points of a search with further seeds, so that the choice has no bias.

The best of many trials is partly the luckiest: the largest of noisy values is too large. So the
best points are trained again, with seeds that the search has not used, until one is shown to be
better than each other (`sweeps.verdicts.best_point`) or every point has the largest number of
seeds. The runs are a study of their own, ``<search> confirmed``, which any number of drivers share
and which a rerun of the command resumes.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from statistics import median
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from sweeps import attributes as names
from sweeps.candidates import SEED, Candidate, Candidates
from sweeps.point import Outcome, Point
from sweeps.rendering.confirmation import Confirmed, confirmation_grid
from sweeps.report.study_data import confirmed_study
from sweeps.settings import Objective, SweepSettings
from sweeps.verdicts.best_point import BestPointJudge, Race, fewest_seeds
from sweeps.verdicts.judge import CellRunId
from sweeps.verdicts.until_decided import PairedSeeds
from sweeps.worker.point_list import PointList, run_points
from sweeps.worker.progress import duration
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import find_study, open_storage, open_study
from sweeps.worker.trial_store import counted_trials

if TYPE_CHECKING:
    import optuna


class Confirmation:
    """Adds seeds to the best points of a search, and keeps the table of it in the search.

    Args:
        search: its study; gets the table.
        candidates: two points or more.
        objectives: of the search; the first one is compared.
    """

    def __init__(
        self, search: optuna.Study, candidates: Candidates, objectives: Sequence[Objective]
    ) -> None:
        self.search = search
        self.candidates = candidates
        self.objectives = objectives
        files = {each.label: each.file for each in candidates.points}
        self._judge = BestPointJudge(files, maximize=objectives[0].direction == "maximize")
        self._seeds = PairedSeeds(candidates.seeds)
        self._ids = {
            self._overrides(each, seed): (each.label, seed)
            for each in candidates.points
            for seed in candidates.seeds
        }

    def points(self, wanted: Sequence[CellRunId] | None = None) -> list[Point]:
        """Points of some candidates and seeds; by default all of those without which
        nothing can be decided.
        """
        if wanted is None:
            first = self.candidates.seeds[: fewest_seeds(len(self.candidates.points))]
            wanted = [(each.label, seed) for seed in first for each in self.candidates.points]
        study = confirmed_study(self.search.study_name)
        by_label = {each.label: each for each in self.candidates.points}
        return [
            Point(
                f"{label} seed={seed}",
                self._overrides(by_label[label], seed),
                tags={f"rgbt.study/{study}": label},
            )
            for label, seed in wanted
        ]

    def __call__(self, outcomes: Sequence[Outcome]) -> list[Point]:
        """The next seed of the points that are still in the race.

        Args:
            outcomes: of all points until now.
        """
        runs = self._runs(outcomes)
        return self.points(self._seeds.further(runs, lambda: self._open(outcomes)))

    def finish(self, outcomes: Sequence[Outcome]) -> None:
        """Write the table after the last run of this call."""
        runs = self._runs(outcomes)
        unfinished = any(outcome.state in ("waiting", "running") for outcome in outcomes)
        left = PairedSeeds(self.candidates.seeds).further(runs, lambda: self._open(outcomes))
        self._write(outcomes, self._race(runs), is_over=not unfinished and not left)

    def _open(self, outcomes: Sequence[Outcome]) -> Iterator[list[str]]:
        """The points that further seeds may tell apart: those without a failed run, if any."""
        runs = self._runs(outcomes)
        found = self._race(runs)
        self._write(outcomes, found, is_over=False)
        if isinstance(found, Race) and not found.obstacle:
            failed = {label for (label, _), run in runs.items() if run.state == "failed"}
            left = [label for label in found.open if label not in failed]
            if len(left) > 1:
                yield left

    def _race(self, runs: Mapping[CellRunId, Outcome]) -> Race | str:
        """The standings, or why there are none."""
        try:
            return self._judge.race(runs)
        except InputError as error:
            return str(error)

    def _write(self, outcomes: Sequence[Outcome], race: Race | str, *, is_over: bool) -> None:
        runs = self._runs(outcomes)
        confirmed = Confirmed(
            found={each.label: each.found for each in self.candidates.points},
            objectives=tuple(each.metric for each in self.objectives),
            maximize=self.objectives[0].direction == "maximize",
            trials=self.candidates.trials,
            seeds=self.candidates.seeds,
            race=race,
            is_over=is_over,
        )
        text = json.dumps(asdict(confirmation_grid(confirmed, runs)))
        if self.search.user_attrs.get(names.CONFIRMATION) != text:
            self.search.set_user_attr(names.CONFIRMATION, text)

    def _runs(self, outcomes: Sequence[Outcome]) -> dict[CellRunId, Outcome]:
        return {self._ids[outcome.point.overrides]: outcome for outcome in outcomes}

    @staticmethod
    def _overrides(candidate: Candidate, seed: int) -> tuple[str, ...]:
        return (*candidate.overrides, f"{SEED}={seed}")


def confirm(
    study: optuna.Study, candidates: Candidates, runs: RunStore, settings: SweepSettings
) -> None:
    """Train the best points of a search with further seeds, and keep the table in its study.

    Args:
        study: of the search.
        candidates: two points or more.
        runs: finished runs.
        settings: of the search; `hours` is what is left of them.
    """
    name = confirmed_study(study.study_name)
    confirmation = Confirmation(study, candidates, settings.objectives)
    storage = open_storage(settings.storage, runs.runs_dir)
    attributes = {names.KIND: "list", names.CONFIRMS: study.study_name}
    if names.COMMAND in study.user_attrs:
        attributes[names.COMMAND] = study.user_attrs[names.COMMAND]
    open_study(name, storage, settings.objectives, attributes)
    points = PointList(
        study=name,
        title=name,
        kind="list",
        points=tuple(confirmation.points()),
        runs=runs,
        more=confirmation,
    )
    # A driver without work waits: a run of another one may show that further seeds are needed.
    confirmation.finish(run_points(points, replace(settings, wait=True)))


def preview_line(study: optuna.Study | None, settings: SweepSettings, runs: RunStore) -> str:
    """What the confirmation may cost, in a sentence."""
    best, most = settings.confirm.best, settings.confirm.max_seeds
    trials = [] if study is None else counted_trials(study)
    seconds = [
        trial.user_attrs[names.SECONDS] / settings.replicates
        for trial in trials
        if trial.state.name == "COMPLETE" and names.SECONDS in trial.user_attrs
    ]
    done = 0
    if study is not None:
        name = confirmed_study(study.study_name)
        confirmed = find_study(name, settings.storage, runs.runs_dir)
        every = [] if confirmed is None else counted_trials(confirmed)
        done = sum(trial.state.name == "COMPLETE" for trial in every)
    left = max(0, best * most - done)
    time = f", {duration(left * median(seconds) / settings.workers)}" if seconds else ""
    before = f" ({done} are finished)" if done else ""
    fewest = min(fewest_seeds(best), most)
    return (
        f"The {best} best points would then be compared with {fewest} to {most} further seeds "
        f"each: at most {left} further runs{time}{before}."
    )
