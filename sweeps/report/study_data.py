"""The trials of a study, read once from Optuna's storage, and what follows from them."""

from __future__ import annotations

import math
import warnings
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from rgbt.config.compose import PIXELS, with_pixels
from sweeps import attributes
from sweeps.point import short_names
from sweeps.worker.trial_store import counted_trials

if TYPE_CHECKING:
    import optuna
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

STATES = ("COMPLETE", "PRUNED", "FAIL", "RUNNING", "WAITING")

MIN_TRIALS = 10
"""Complete trials below which importances would be noise: PED-ANOVA looks at the best tenth."""

ADVISED = 50
"""Complete trials from which the best tenth has the five that PED-ANOVA's authors ask for."""


@dataclass(frozen=True)
class StudyData:
    """A study at one moment.

    Attributes:
        name: of the study.
        kind: "search", "grid" or "list".
        metrics: names of the objectives.
        maximize: whether more is better, by objective.
        trials: those that count, by number.
        command: that created the study, or "".
    """

    name: str
    kind: str
    metrics: tuple[str, ...]
    maximize: tuple[bool, ...]
    trials: tuple[FrozenTrial, ...]
    command: str = ""

    def of_state(self, *states: str) -> list[FrozenTrial]:
        """Trials in one of these states (names as in `STATES`), by number."""
        return [trial for trial in self.trials if trial.state.name in states]

    @cached_property
    def complete(self) -> list[FrozenTrial]:
        """Trials whose objectives are all known and finite, by number."""
        complete = self.of_state("COMPLETE")
        return [trial for trial in complete if all(map(math.isfinite, trial.values))]

    def counts(self) -> dict[str, int]:
        """Number of trials by state, those of `STATES` in order."""
        counter = Counter(trial.state.name for trial in self.trials)
        return {state: counter[state] for state in STATES}

    @cached_property
    def distributions(self) -> Mapping[str, BaseDistribution]:
        """Each parameter's distribution, in the order in which the trials first have them."""
        distributions: dict[str, BaseDistribution] = {}
        for trial in self.trials:
            for name, distribution in trial.distributions.items():
                distributions.setdefault(name, distribution)
        return distributions

    @cached_property
    def front(self) -> list[FrozenTrial]:
        """The Pareto front, best first objective first; with one objective its best trials."""
        if not self.complete:
            return []
        # The complete trials come first in the copy: its numbers are indices of our list.
        best = self.in_memory().best_trials
        return sorted((self.complete[each.number] for each in best), key=self.rank)

    def in_memory(self) -> optuna.Study:
        """The complete trials, then the pruned ones, in memory and numbered anew."""
        import optuna

        ways = (optuna.study.StudyDirection.MINIMIZE, optuna.study.StudyDirection.MAXIMIZE)
        study = optuna.create_study(directions=[ways[up] for up in self.maximize])
        study.add_trials([*self.complete, *self.of_state("PRUNED")])
        return study

    @cached_property
    def latest(self) -> list[FrozenTrial]:
        """The latest trial of each point: earlier ones failed and were retried."""
        last = {t.user_attrs.get(attributes.KEY, t.number): t for t in self.trials}
        return sorted(last.values(), key=lambda trial: trial.number)

    def rank(self, trial: FrozenTrial) -> tuple[float, int]:
        """Sorts complete trials by their first objective, best first, then by number."""
        return (-1.0 if self.maximize[0] else 1.0) * trial.values[0], trial.number

    def of_objective(self, index: int, *, with_others: bool = False) -> optuna.Study:
        """The complete trials in memory with one objective and parameters as shown.

        Args:
            index: of the objective.
            with_others: the other objectives are parameters.
        """
        import optuna
        from optuna.distributions import CategoricalDistribution, FloatDistribution

        study = optuna.create_study(direction="maximize" if self.maximize[index] else "minimize")
        others = [i for i in range(len(self.metrics)) if with_others and i != index]
        for trial in self.complete:
            params, kinds = dict(trial.params), dict(trial.distributions)
            for name, kind in trial.distributions.items():
                if isinstance(kind, CategoricalDistribution):
                    params[name] = self.shown(params[name])
                    kinds[name] = CategoricalDistribution(tuple(map(self.shown, kind.choices)))
            for other in others:
                column = [each.values[other] for each in self.complete]
                params[self.metrics[other]] = trial.values[other]
                kinds[self.metrics[other]] = FloatDistribution(min(column), max(column))
            value = trial.values[index]
            study.add_trial(
                optuna.trial.create_trial(value=value, params=params, distributions=kinds)
            )
        return study

    def direction(self, index: int) -> str:
        """An objective as the title of an axis."""
        return f"{self.metrics[index]} ({'higher' if self.maximize[index] else 'lower'} is better)"

    def shown(self, value: object) -> str:
        """A parameter's value as shown."""
        factors = {trial.user_attrs.get(attributes.PIXELS) for trial in self.trials}
        return shown(value, factors.pop() if len(factors) == 1 else None)

    def label(self, trial: FrozenTrial) -> str:
        """How a trial is shown: its label, else its parameters, else its number."""
        short = short_names(self.distributions)
        pairs = [f"{short[name]}={self.shown(value)}" for name, value in trial.params.items()]
        return str(trial.user_attrs.get(attributes.LABEL) or " ".join(pairs) or trial.number)


def read(study: optuna.Study) -> StudyData:
    """Read a study."""
    notes = study.user_attrs
    names = notes.get(attributes.METRICS) or study.metric_names
    count = len(study.directions)
    metrics = tuple(names or (f"objective {index + 1}" for index in range(count)))
    return StudyData(
        name=study.study_name,
        kind=str(notes.get(attributes.KIND, "search")),
        metrics=metrics,
        maximize=tuple(direction.name == "MAXIMIZE" for direction in study.directions),
        trials=tuple(counted_trials(study)),
        command=str(notes.get(attributes.COMMAND, "")),
    )


def shown(value: object, pixel_factor: float | None = None) -> str:
    """A parameter's value as shown: four significant digits; ``${px:64}`` as its value.

    Args:
        value: of a trial.
        pixel_factor: by which pixels of the paper's images are scaled; None: unknown.
    """
    if isinstance(value, str) and PIXELS.search(value):
        if pixel_factor is None:
            return PIXELS.sub(r"\1px", value)
        return with_pixels(value, pixel_factor)
    return f"{value:.4g}" if isinstance(value, float) else str(value)


@dataclass(frozen=True)
class Importances:
    """How much the objectives depend on each parameter.

    Attributes:
        shares: parameter -> share by objective, which sum to 1 over the parameters; NaN for an
            objective that has one value only. Most important for the first objective first.
        remark: why there are none, what was left out, or how uncertain they are; "" if nothing.
    """

    shares: Mapping[str, tuple[float, ...]]
    remark: str


def importances(data: StudyData) -> Importances:
    """Importances by PED-ANOVA, which is Optuna's default: of reaching the best tenth.

    Source: Watanabe et al., "PED-ANOVA", IJCAI 2023, arXiv 2304.10255.
    """
    count = len(data.complete)
    if data.kind == "list":
        return Importances({}, "")
    if count < MIN_TRIALS:
        return Importances({}, f"they need {MIN_TRIALS} complete trials, and there are {count}.")
    values = {
        name: {trial.params[name] for trial in data.complete if name in trial.params}
        for name in data.distributions
    }
    varied = [name for name in values if len(values[name]) > 1]
    if not varied:
        return Importances({}, "no parameter took two values.")
    found = [_of_objective(data, index, varied) for index in range(len(data.metrics))]
    shares = {name: tuple(each[name] for each in found) for name in varied}
    constant = ", ".join(name for name in data.distributions if name not in varied)
    flat = [data.metrics[i] for i, each in enumerate(found) if math.isnan(each[varied[0]])]
    remark = " ".join(
        [
            *([f"{constant}: one value only, excluded."] if constant else []),
            *([f"{', '.join(flat)}: the same value in all trials."] if flat else []),
            *([f"rough: {count} complete trials, {ADVISED} are recommended."] * (count < ADVISED)),
        ]
    )
    if len(flat) == len(data.metrics):
        return Importances({}, remark)
    order = sorted(varied, key=lambda name: [-np.nan_to_num(share) for share in shares[name]])
    return Importances({name: shares[name] for name in order}, remark)


def _of_objective(data: StudyData, index: int, names: list[str]) -> dict[str, float]:
    """Shares for one objective; NaN where all trials have the same value."""
    import optuna

    if len({trial.values[index] for trial in data.complete}) == 1:
        return dict.fromkeys(names, math.nan)
    with warnings.catch_warnings():
        # The remark says how uncertain the shares are.
        warnings.filterwarnings("ignore", "Some regimes for parameter", UserWarning)
        return optuna.importance.get_param_importances(data.of_objective(index), params=names)


@dataclass(frozen=True)
class PruningSavings:
    """Training steps saved by pruning.

    Attributes:
        trials: pruned ones that reported.
        share: of the training steps that complete and pruned trials would have made, 0..1.
    """

    trials: int
    share: float


def pruning_savings(data: StudyData) -> PruningSavings | None:
    """Training steps saved; None where no complete trial reported its steps.

    A pruned trial saves the steps between its last report and the last step of complete trials,
    and all steps of its further seeds, which never begin.
    """
    full = max((step for trial in data.complete for step in trial.intermediate_values), default=0)
    pruned = [trial for trial in data.of_state("PRUNED") if trial.intermediate_values]
    if full <= 0:
        return None
    full_steps = sum(full * _num_runs(trial) for trial in [*pruned, *data.complete])
    saved = sum(full * _num_runs(t) - max(t.intermediate_values) for t in pruned)
    return PruningSavings(len(pruned), max(saved, 0) / full_steps)


def _num_runs(trial: FrozenTrial) -> int:
    return max(1, len(trial.user_attrs.get(attributes.RUNS, ())))
