"""The points of a search: what its sampler proposes, and what is reported of them."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from sweeps import attributes as names
from sweeps.plan.planner import Planner
from sweeps.point import Point
from sweeps.run.optuna_study import values_of
from sweeps.run.running_point import End, PruningCallback, Task
from sweeps.settings import SweepSettings

if TYPE_CHECKING:
    import optuna
    from optuna.trial import Trial

    from sweeps.space import Space

# Optuna's states, and the words of a driver.
STATES = {"COMPLETE": "finished", "FAIL": "failed", "PRUNED": "pruned"}


class SearchSource:
    """Gets points from the sampler of a study, first those that a driver before has left.

    `fixed` are overrides that all trials share; `say` is called with ("failed", label and reason)
    for a point whose configuration is wrong.
    """

    def __init__(
        self,
        fixed: Sequence[str],
        space: Space,
        study: optuna.Study,
        settings: SweepSettings,
        say: Callable[[str, str], None],
        planner: Planner | None = None,
    ) -> None:
        from optuna.trial import Trial

        self._fixed, self._space, self._study = tuple(fixed), space, study
        self._settings, self._say, self._planner = settings, say, planner or Planner()
        stored = study.get_trials(deepcopy=False)
        self._first = len(stored)  # number of the first trial of this driver
        self._left = [Trial(study, t._trial_id) for t in stored if t.state.name == "RUNNING"]
        # Steps of which the pruner knows.
        self._reported = {trial.number: trial.last_step or 0 for trial in stored}
        self._trials: dict[int, Trial] = {}
        self._counts = Counter(STATES[t.state.name] for t in stored if t.state.is_finished())

    def next(self) -> Task | None:
        """See `Source.next`."""
        while (trial := self._next_trial()) is not None:
            self._trials[trial.number] = trial
            point = self._point(trial)
            try:
                plan = self._planner.plan(point)
            except InputError as error:
                trial.set_user_attr(names.LABEL, point.label)
                self._end(trial.number, End("failed", str(error)))
                self._say("failed", f"{point.label}: {error}")
                continue
            trial.set_user_attr(names.LABEL, plan.point.label)
            trial.set_user_attr(names.RUNS, [run.key for run in plan.runs])
            trial.set_user_attr(names.PIXELS, plan.runs[0].scale.pixel_factor)
            is_left = trial.number < self._first
            return Task(plan, trial.number, self._pruning_callback(trial), is_left)
        return None

    def record(self, task: Task, end: End) -> End:
        """See `Source.record`."""
        end = end.checked(self._settings.objectives)
        self._end(task.number, end)
        return end

    def counts(self) -> Counter[str]:
        """See `Source.counts`."""
        found = self._counts + Counter(running=len(self._trials))
        if self._settings.trials is not None:
            found["waiting"] = max(0, self._settings.trials - found.total())
        return found

    def _next_trial(self) -> Trial | None:
        if self._left:
            trial = self._left.pop(0)
            for name, distribution in self._space.items():  # of a driver killed meanwhile
                trial._suggest(name, distribution)
            return trial
        total, known = self._settings.trials, self._study.get_trials(deepcopy=False)
        if total is not None and sum(trial.state.name != "WAITING" for trial in known) >= total:
            return None
        if total is None:  # by hours, it would propose the same points again and again
            tried = {json.dumps(trial.params, sort_keys=True) for trial in known}
            if len(tried) >= _number_of_points(self._space):
                return None
        return self._study.ask(dict(self._space))

    def _point(self, trial: Trial) -> Point:
        from sweeps.space import as_overrides

        # A stored trial may have more parameters, which are not ours to compose.
        params = {key: value for key, value in trial.params.items() if key in self._space}
        chosen, replicates = as_overrides(params), self._settings.replicates
        tags = {f"rgbt.study/{self._study.study_name}": str(trial.number), VARIED: " ".join(params)}
        return Point(
            label=f"#{trial.number} " + " ".join(map(_short, chosen)),
            overrides=(*self._fixed, *chosen),
            params=params,
            tags=tags,
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )

    def _end(self, number: int, end: End) -> None:
        from optuna.trial import TrialState

        state = next(name for name, word in STATES.items() if word == end.state)
        trial, values = self._trials.pop(number), values_of(end, self._settings.objectives)
        for name, value in end.notes().items():
            trial.set_user_attr(name, value)
        self._study.tell(number, values, state=TrialState[state])
        self._counts[end.state] += 1

    def _pruning_callback(self, trial: Trial) -> PruningCallback | None:
        if self._settings.pruner is None and len(self._settings.objectives) > 1:
            return None
        metric = self._settings.objectives[0].metric.removeprefix("val/")

        def report(line: MetricLine) -> str:
            if metric not in line.values or line.step <= self._reported.get(trial.number, 0):
                return ""
            trial.report(in_percent(metric, line.values[metric]), line.step)
            self._reported[trial.number] = line.step
            is_pruned = self._settings.pruner is not None and trial.should_prune()
            return f"pruned at step {line.step}" if is_pruned else ""

        return report


def _number_of_points(space: Space) -> float:
    """How many points a space has; infinite where a range has no steps."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution

    found = 1.0
    for each in space.values():
        if isinstance(each, CategoricalDistribution):
            found *= len(each.choices)
        elif isinstance(each, FloatDistribution) and each.step is None:
            return math.inf
        else:
            found *= (each.high - each.low) // (each.step or 1) + 1
    return found


def _short(override: str) -> str:
    """The label of a parameter: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
