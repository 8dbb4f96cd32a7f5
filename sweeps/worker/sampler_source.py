"""Trials of a search: its sampler chooses them until the budget is spent."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.metrics.names import in_percent
from rgbt.spec.naming import VARIED
from rgbt.tracking.run_folder import MetricLine
from sweeps import attributes as names
from sweeps.point import COLOUR, Point, colour
from sweeps.settings import SweepSettings
from sweeps.worker.planner import Planner
from sweeps.worker.running_trial import PruningCallback
from sweeps.worker.trial_source import ClaimedTrial, trial_attributes
from sweeps.worker.trial_store import TrialStore

if TYPE_CHECKING:
    from optuna.trial import FrozenTrial, Trial

    from sweeps.space.space import Parameter

PAUSE_S = 5.0
"""How long a search waits after a point that is being run already."""


class SamplerSource:
    """Asks the sampler of a study for trials.

    Args:
        fixed: overrides that all trials share.
        parameters: the space.
        store: the study, with its sampler.
        planner: composes the points.
        settings: `trials`, `replicates`, `pruner` and `objectives` count here.
        on_reject: called with (label, reason) for a point whose configuration is wrong.
    """

    requeues = True

    def __init__(
        self,
        fixed: Sequence[str],
        parameters: tuple[Parameter, ...],
        store: TrialStore,
        planner: Planner,
        settings: SweepSettings,
        on_reject: Callable[[str, str], None],
    ) -> None:
        self._fixed = tuple(fixed)
        self._parameters = parameters
        self._store = store
        self._planner = planner
        self._settings = settings
        self._on_reject = on_reject
        self._not_before = 0.0
        self.rejected = 0

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        if time.monotonic() < self._not_before:
            return None
        trial = self._store.ask(self._settings.trials)
        if trial is None:
            return None
        point = self._point(trial)
        try:
            plan = self._planner.plan(point)
        except InputError as error:
            self._store.fail(trial.number, str(error), {names.LABEL: point.label})
            self.rejected += 1
            self._on_reject(point.label, str(error))
            return None
        if self._resolve_duplicate(trial, self._store.by_key().get(plan.key, [])):
            return None
        self._store.set_attributes(trial.number, {names.KEY: plan.key, **trial_attributes(plan)})
        return ClaimedTrial(plan, trial.number, self._pruning_callback(trial))

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = [trial.state.name for trial in self._store.trials()]
        total = self._settings.trials
        unfinished = {"RUNNING", "WAITING"} if wait else {"WAITING"}
        return total is not None and len(states) >= total and not unfinished & set(states)

    def _point(self, trial: Trial) -> Point:
        from sweeps.space.space import as_overrides, suggest

        params = suggest(trial, self._parameters)
        chosen = as_overrides(params)
        study = self._store.study.study_name
        replicates = self._settings.replicates
        return Point(
            label=f"#{trial.number} " + " ".join(map(short_override, chosen)),
            overrides=(*self._fixed, *chosen),
            params=dict(trial.params),
            tags={
                f"rgbt.study/{study}": str(trial.number),
                VARIED: " ".join(params),
                COLOUR: colour(study, trial.number),
            },
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )

    def _resolve_duplicate(self, trial: Trial, same: Sequence[FrozenTrial]) -> bool:
        """Copy a complete trial of the same point, or drop this one for a running trial of it."""
        for other in same:
            if other.number == trial.number:
                continue
            reason = f"the same point as trial {other.number}"
            if other.state.name == "COMPLETE":
                kept = {
                    key: other.user_attrs[key] for key in (names.KEY, names.RUNS, names.RESULTS)
                }
                label = f"#{trial.number} = #{other.number}"
                notes = {**kept, names.REASON: reason, names.LABEL: label}
                self._store.complete(trial.number, other.values, notes)
                return True
            if other.state.name == "RUNNING":
                self._store.drop(trial.number, reason)
                self._not_before = time.monotonic() + PAUSE_S
                return True
        return False

    def _pruning_callback(self, trial: Trial) -> PruningCallback | None:
        if self._settings.pruner is None and len(self._settings.objectives) > 1:
            return None
        metric = self._settings.objectives[0].metric.removeprefix("val/")
        reported: set[int] = set()

        def report(line: MetricLine) -> str:
            value = line.values.get(metric)
            if value is None or line.step in reported:
                return ""
            percent = in_percent(metric, value)
            self._store.update_unfinished(trial.number, lambda: trial.report(percent, line.step))
            reported.add(line.step)
            if self._settings.pruner is not None and trial.should_prune():
                return f"pruned at step {line.step}"
            return ""

        return report


def short_override(override: str) -> str:
    """An override as shown: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
