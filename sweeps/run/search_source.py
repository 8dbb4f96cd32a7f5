"""The points of a search: what its sampler proposes, and what is reported of them."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import optuna
from optuna.distributions import CategoricalDistribution, FloatDistribution
from optuna.trial import Trial, TrialState

from rgbt.checks import InputError
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED, short_word
from sweeps import attributes as names
from sweeps.plan.planner import PlannedPoint, Planner
from sweeps.point import Outcome, Point
from sweeps.run.point_state import stored_outcome
from sweeps.run.run_store import RunStore
from sweeps.run.running_point import read_metrics
from sweeps.settings import Objective, SweepSettings
from sweeps.space import Distribution, Space, as_overrides, build_sampler

# States of trials, and the words of a driver.
STATES = {
    TrialState.COMPLETE: "finished",
    TrialState.FAIL: "failed",
    TrialState.PRUNED: "pruned",
}


@dataclass
class SearchSource:
    """Gets points from the sampler of a study, first those that a driver before has left.

    Attributes:
        fixed: overrides that all trials share.
        say: called with a state and a text for a point that ends before it is given to the driver.
    """

    fixed: tuple[str, ...]
    space: Space
    study: optuna.Study
    settings: SweepSettings
    runs: RunStore
    say: Callable[[str, str], None]
    planner: Planner = field(default_factory=Planner)

    def __post_init__(self) -> None:
        stored = self.study.get_trials(deepcopy=False)
        self._left = [trial for trial in stored if trial.state == TrialState.RUNNING]
        # Steps of which the pruner knows, by the number of the trial.
        self._reported = {trial.number: trial.last_step or 0 for trial in stored}
        self._trials: dict[str, Trial] = {}  # those that run, by their label with their number
        self._counts = Counter(STATES[t.state] for t in stored if t.state in STATES)

    def next(self) -> PlannedPoint | None:
        """See `Source.next`."""
        while True:
            is_left = bool(self._left)
            trial = self._left_trial() if is_left else self._new_trial()
            if trial is None:
                return None
            point = self._point(trial)
            try:
                plan = self.planner.plan(point)
            except InputError as error:
                trial.set_user_attr(names.LABEL, point.label)
                self._end(trial, Outcome(point, "failed", str(error)))
                self.say("failed", f"{point.label}: {error}")
                continue
            self._trials[plan.point.label] = trial
            trial.set_user_attr(names.LABEL, plan.point.label)
            trial.set_user_attr(names.RUNS, [run.key for run in plan.runs])
            trial.set_user_attr(names.PIXELS, plan.runs[0].scale.pixel_factor)
            # What made another trial with these values fail may be repaired.
            is_retried = not is_left or self.settings.retry == "failed"
            outcome = stored_outcome(plan, self.runs, is_retried=is_retried)
            if outcome.state == "waiting":
                return plan
            for line in read_metrics(self.runs.runs_dir / plan.runs[0].key):
                if line.kind == "val":
                    self.report(plan, line)
            outcome = self.record(plan, replace(outcome, job_s=round(outcome.seconds or 0.0, 1)))
            self.say(outcome.state, f"{plan.point.label}  {outcome.reason}".rstrip())

    def report(self, plan: PlannedPoint, line: MetricLine) -> str:
        """See `Source.report`; a search of several objectives reports nothing."""
        metric = self.settings.objectives[0].metric.removeprefix("val/")
        trial = self._trials[plan.point.label]
        is_known = line.step <= self._reported.get(trial.number, 0)
        if len(self.settings.objectives) > 1 or metric not in line.values or is_known:
            return ""
        trial.report(in_percent(metric, line.values[metric]), line.step)
        self._reported[trial.number] = line.step
        is_pruned = self.settings.pruner is not None and trial.should_prune()
        return f"pruned at step {line.step}" if is_pruned else ""

    def record(self, plan: PlannedPoint, outcome: Outcome) -> Outcome:
        """See `Source.record`."""
        counted = checked(outcome, self.settings.objectives)
        self._end(self._trials.pop(plan.point.label), counted)
        return counted

    def counts(self) -> Counter[str]:
        """See `Source.counts`."""
        found = self._counts + Counter(running=len(self._trials))
        if self.settings.trials is not None:
            found["waiting"] = max(0, self.settings.trials - found.total())
        return found

    def _left_trial(self) -> Trial:
        stored = self._left.pop(0)
        self.study.sampler = build_sampler(self.settings.sampler, stored.number)
        trial = Trial(self.study, stored._trial_id)
        for name, distribution in self.space.items():
            _suggest(trial, name, distribution)
        return trial

    def _new_trial(self) -> Trial | None:
        total, known = self.settings.trials, self.study.get_trials(deepcopy=False)
        waiting = [trial.number for trial in known if trial.state == TrialState.WAITING]
        if total is not None and len(known) - len(waiting) >= total:
            return None
        if total is None:  # by hours, it would propose the same points again and again
            tried = {json.dumps(trial.params, sort_keys=True) for trial in known}
            if len(tried) >= _number_of_points(self.space):
                return None
        number = min(waiting, default=len(known))  # trials that the user has added come first
        self.study.sampler = build_sampler(self.settings.sampler, number)
        return self.study.ask(dict(self.space))

    def _point(self, trial: Trial) -> Point:
        # A stored trial may have more parameters, which are not ours to compose.
        params = {key: value for key, value in trial.params.items() if key in self.space}
        chosen, replicates = as_overrides(params), self.settings.replicates
        tags = {f"rgbt.study/{self.study.study_name}": str(trial.number), VARIED: " ".join(params)}
        return Point(
            label=f"#{trial.number} {' · '.join(map(short_word, chosen))}",
            overrides=(*self.fixed, *chosen),
            params=params,
            tags=tags,
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )

    def _end(self, trial: Trial, outcome: Outcome) -> None:
        values = None
        trial.set_user_attr(names.SECONDS, outcome.job_s)
        if outcome.state == "finished":
            scores = outcome.scores()
            values = [scores[objective.metric] for objective in self.settings.objectives]
            trial.set_user_attr(names.RESULTS, scores)
        else:
            trial.set_user_attr(names.REASON, outcome.reason)
        state = next(state for state, word in STATES.items() if word == outcome.state)
        self.study.tell(trial.number, values, state=state)
        self._counts[outcome.state] += 1


def checked(outcome: Outcome, objectives: Sequence[Objective]) -> Outcome:
    """Return the outcome, or a failed one where finished runs lack the score of an objective."""
    if outcome.state != "finished":
        return outcome
    scores = outcome.scores()
    for objective in objectives:
        name = objective.metric
        if not math.isfinite(scores.get(name, math.nan)):
            reason = f"its runs have no {name} that is a number"
            return replace(outcome, state="failed", reason=reason)
    return outcome


def _suggest(trial: Trial, name: str, distribution: Distribution) -> None:
    """Draw a parameter of a trial that a driver has left while it asked for it."""
    if isinstance(distribution, CategoricalDistribution):
        trial.suggest_categorical(name, distribution.choices)
    elif isinstance(distribution, FloatDistribution):
        low, high, step = distribution.low, distribution.high, distribution.step
        trial.suggest_float(name, low, high, step=step, log=distribution.log)
    else:
        first, last, width = distribution.low, distribution.high, distribution.step
        trial.suggest_int(name, first, last, step=width, log=distribution.log)


def _number_of_points(space: Space) -> float:
    """Return how many points a space has; infinite where a range has no steps."""
    found = 1.0
    for distribution in space.values():
        if isinstance(distribution, CategoricalDistribution):
            found *= len(distribution.choices)
        elif isinstance(distribution, FloatDistribution) and distribution.step is None:
            return math.inf
        else:
            found *= (distribution.high - distribution.low) // (distribution.step or 1) + 1
    return found
