"""Selects the next trial of a driver: the interface, and the proposals of a search sampler."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol

from rgbt.checks import InputError
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from rgbt.runs.provenance import without_passwords
from sweeps import attributes as names
from sweeps.point import Point
from sweeps.settings import SweepSettings
from sweeps.worker.planner import PlannedPoint, Planner
from sweeps.worker.running_trial import ClaimedTrial, PruningCallback
from sweeps.worker.trial_store import TrialStore

if TYPE_CHECKING:
    from optuna.trial import Trial

    from sweeps.space import Space


class TrialSource(Protocol):
    """Gives a driver its trials."""

    requeues: bool  # whether the study gives a point that failed to a driver again
    rejected: int  # points whose configuration is wrong

    def next(self) -> ClaimedTrial | None:
        """The next trial, claimed for this driver; None when there is none at the moment."""

    def is_exhausted(self, *, wait: bool) -> bool:
        """Whether no trial is left; with `wait`, whether other drivers have finished too."""


def trial_attributes(plan: PlannedPoint) -> Mapping[str, Any]:
    """User attributes of a trial of a point."""
    return {
        names.KEY: plan.key,
        names.OVERRIDES: [without_passwords(word) for word in plan.point.overrides],
        names.RUNS: [run.key for run in plan.runs],
        names.PIXELS: plan.runs[0].scale.pixel_factor,
        names.LABEL: plan.point.label,
    }


@dataclass
class SamplerSource:
    """Gets trials from the sampler of a study; equal points use, or adopt, the same run.

    Attributes:
        fixed: overrides that all trials share.
        on_reject: called with (label, reason) for a point whose configuration is wrong.
    """

    fixed: Sequence[str]
    space: Space
    store: TrialStore
    planner: Planner
    settings: SweepSettings
    on_reject: Callable[[str, str], None]
    requeues: bool = True
    rejected: int = 0

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        from sweeps.space import as_overrides

        trial = self.store.ask(self.settings.trials, self.space)
        if trial is None:
            return None
        chosen, number = as_overrides(trial.params), trial.number
        study, replicates = self.store.study.study_name, self.settings.replicates
        tags = {f"rgbt.study/{study}": str(number), VARIED: " ".join(trial.params)}
        point = Point(
            label=f"#{number} " + " ".join(map(_short, chosen)),
            overrides=(*self.fixed, *chosen),
            params=dict(trial.params),
            tags=tags,
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )
        try:
            plan = self.planner.plan(point)
        except InputError as error:
            self.store.fail(number, str(error), {names.LABEL: point.label})
            self.rejected += 1
            self.on_reject(point.label, str(error))
            return None
        noted = trial_attributes(plan)
        self.store.update_unfinished(number, lambda: self.store.set_attributes(number, noted))
        return ClaimedTrial(plan, number, self._pruning_callback(trial))

    def is_exhausted(self, *, wait: bool) -> bool:
        """See `TrialSource.is_exhausted`."""
        states = [trial.state.name for trial in self.store.trials()]
        total = self.settings.trials
        unfinished = {"RUNNING", "WAITING"} if wait else {"WAITING"}
        return total is not None and len(states) >= total and not unfinished & set(states)

    def _pruning_callback(self, trial: Trial) -> PruningCallback | None:
        if self.settings.pruner is None and len(self.settings.objectives) > 1:
            return None
        metric = self.settings.objectives[0].metric.removeprefix("val/")
        reported: set[int] = set()

        def report(line: MetricLine) -> str:
            value = line.values.get(metric)
            if value is None or line.step in reported:
                return ""
            percent = in_percent(metric, value)
            self.store.update_unfinished(trial.number, lambda: trial.report(percent, line.step))
            reported.add(line.step)
            is_pruned = self.settings.pruner is not None and trial.should_prune()
            return f"pruned at step {line.step}" if is_pruned else ""

        return report


def _short(override: str) -> str:
    """As shown: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
