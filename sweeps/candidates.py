"""The best points of a search, which further seeds confirm (`sweeps.confirmation`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rgbt.checks import InputError
from rgbt.metrics.names import CA, TC
from rgbt.metrics.pairs import HEADLINES, PROTOCOLS, file_name
from rgbt.runs.folder import counts_name
from rgbt.runs.run_spec import RunSpec
from sweeps import attributes as names
from sweeps.report.study_data import read
from sweeps.settings import Objective, SweepSettings
from sweeps.space.space import Parameter, as_overrides, suggest
from sweeps.verdicts.best_point import ScoreFile, fewest_seeds
from sweeps.worker.planner import specify_run
from sweeps.worker.trial_sources import short_override

if TYPE_CHECKING:
    import optuna
    from optuna.trial import FrozenTrial

SEED = "seed"


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """A point that is confirmed.

    Attributes:
        label: its trial and values: "#12 sigma_div=4.12".
        overrides: of its runs, without the seed.
        found: value of the first objective in the search.
        file: where its runs have the first objective.
    """

    label: str
    overrides: tuple[str, ...]
    found: float
    file: ScoreFile


@dataclass(frozen=True, kw_only=True)
class Candidates:
    """The best points of a search, and the seeds that they may get.

    Attributes:
        trials: number of complete trials that the points were chosen from.
    """

    points: tuple[Candidate, ...]
    seeds: range
    trials: int

    @classmethod
    def of(
        cls,
        study: optuna.Study,
        fixed: Sequence[str],
        parameters: tuple[Parameter, ...],
        settings: SweepSettings,
    ) -> Candidates:
        """The best points: by the first objective, of two objectives those of the Pareto front.

        Raises:
            InputError: the first objective is not a score of counts.
        """
        data = read(study)
        best = data.front if len(data.metrics) > 1 else sorted(data.complete, key=data.rank)
        points: dict[str, Candidate] = {}
        used: set[int] = set(range(settings.replicates))
        for trial in best:
            if len(points) == settings.confirm.best:
                break
            key = trial.user_attrs[names.KEY]
            if key in points:
                continue
            chosen = chosen_overrides(trial, parameters)
            spec = specify_run((*fixed, *chosen))
            if settings.replicates == 1:
                used.add(spec.seed)
            points[key] = Candidate(
                label=" ".join([f"#{trial.number}", *map(short_override, chosen)]),
                overrides=(*fixed, *chosen),
                found=trial.values[0],
                file=score_file(settings.objectives[0], spec),
            )
        # Seeds of the search would bias the comparison: a point was chosen because its score with
        # these seeds was high. The following seeds were not part of any choice.
        first = max(used) + 1
        seeds = range(first, first + settings.confirm.max_seeds)
        return cls(points=tuple(points.values()), seeds=seeds, trials=len(data.complete))


def chosen_overrides(trial: FrozenTrial, parameters: tuple[Parameter, ...]) -> tuple[str, ...]:
    """The values that a trial of a search has, as overrides."""
    from optuna.trial import FixedTrial

    return as_overrides(suggest(FixedTrial(trial.params), parameters))


def score_file(objective: Objective, spec: RunSpec) -> ScoreFile:
    """Where the runs of a specification have an objective."""
    kind, _, score = objective.metric.partition("/")
    split = spec.trainer.selection_split if kind == "val" else kind
    if not objective.is_consistency:
        return ScoreFile(metric=score, path=counts_name(split))
    name, _, word = score.partition("/")
    (protocol,) = (each for each in PROTOCOLS if each == word)
    metric = dict(zip((TC, CA), HEADLINES[protocol][:2], strict=True))[name]
    mark = str(spec.consistency.build().mark)
    return ScoreFile(metric=metric, path=file_name(protocol, split, mark))


def check_confirmable(settings: SweepSettings, parameters: Sequence[Parameter]) -> None:
    """Refuse what cannot be confirmed, before the search starts.

    Raises:
        InputError: no end of the search, too few seeds, or a search over seeds.
    """
    if not settings.confirm.best:
        return
    if settings.trials is None:
        raise InputError(
            "hydra.sweeper.confirm compares the best points after the last trial; set the number "
            "of trials with hydra.sweeper.trials=40."
        )
    best, most = settings.confirm.best, settings.confirm.max_seeds
    fewest = fewest_seeds(best)
    if most < fewest:
        raise InputError(
            f"hydra.sweeper.confirm.max_seeds={most} is too small: fewer than {fewest} seeds never "
            f"show which of {best} points is the best. Set max_seeds={fewest} or more."
        )
    if SEED in {parameter.key for parameter in parameters}:
        raise InputError(
            "hydra.sweeper.confirm trains the best points with further seeds, but the search has "
            "seed among its parameters; remove it from the space, or set "
            "hydra.sweeper.confirm.best=0."
        )
