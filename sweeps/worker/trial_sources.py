"""The trials of a search: what its sampler proposes, and what is reported of them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.metrics.names import in_percent
from rgbt.runs.folder import MetricLine
from rgbt.runs.naming import VARIED
from sweeps import attributes as names
from sweeps.point import Point
from sweeps.settings import SweepSettings
from sweeps.worker.planner import Planner
from sweeps.worker.running_trial import ClaimedTrial, PruningCallback
from sweeps.worker.storage import TrialStore

if TYPE_CHECKING:
    from optuna.trial import Trial

    from sweeps.space import Space


@dataclass
class SamplerSource:
    """Gets trials from the sampler of a study; equal points use, or adopt, the same run.

    Attributes:
        fixed: overrides that all trials share.
        say: called with ("failed", label and reason) for a point whose configuration is wrong.
    """

    fixed: Sequence[str]
    space: Space
    store: TrialStore
    planner: Planner
    settings: SweepSettings
    say: Callable[[str, str], None]

    def next(self) -> ClaimedTrial | None:
        """See `TrialSource.next`."""
        from sweeps.space import as_overrides

        trial = self.store.ask(self.settings.trials, self.space)
        if trial is None:
            return None
        # A stored trial may have more parameters, which are not ours to compose.
        params = {key: value for key, value in trial.params.items() if key in self.space}
        chosen, number = as_overrides(params), trial.number
        study, replicates = self.store.study.study_name, self.settings.replicates
        tags = {f"rgbt.study/{study}": str(number), VARIED: " ".join(params)}
        point = Point(
            label=f"#{number} " + " ".join(map(_short, chosen)),
            overrides=(*self.fixed, *chosen),
            params=params,
            tags=tags,
            seeds=tuple(range(replicates)) if replicates > 1 else (),
        )
        try:
            plan = self.planner.plan(point)
        except InputError as error:
            self.store.fail(number, str(error), {names.LABEL: point.label})
            self.say("failed", f"{point.label}: {error}")
            return None
        self.store.update_unfinished(number, plan.attributes)
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

        def report(line: MetricLine) -> str:
            if metric not in line.values:
                return ""
            percent = in_percent(metric, line.values[metric])
            self.store.update_unfinished(trial.number, {}, lambda: trial.report(percent, line.step))
            is_pruned = self.settings.pruner is not None and trial.should_prune()
            return f"pruned at step {line.step}" if is_pruned else ""

        return report


def _short(override: str) -> str:
    """The label of a parameter: "masker.sigma_div=4.123456" as "sigma_div=4.123"."""
    key, _, value = override.lstrip("+").partition("=")
    with suppress(ValueError):
        value = f"{float(value):.4g}"
    return f"{key.rpartition('.')[2]}={value}"
