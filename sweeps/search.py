"""A search: a sampler selects the points, a pruner stops bad ones, drivers share the study."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rgbt.checks import InputError, RunError
from rgbt.runs.provenance import command_line
from rgbt.runs.run_spec import RunSpec
from rgbt.terminal import info
from sweeps import attributes as names
from sweeps.settings import SweepSettings
from sweeps.space.samplers import build_pruner, build_sampler
from sweeps.space.space import Parameter, as_overrides, signature, suggest
from sweeps.study import dashboard_command, report, show_links, study_folder
from sweeps.worker.driver import drive
from sweeps.worker.planner import Planner, specify_run
from sweeps.worker.progress import ProgressView
from sweeps.worker.run_store import RunStore
from sweeps.worker.storage import find_study, open_storage, open_study
from sweeps.worker.trial_sources import SamplerSource
from sweeps.worker.trial_store import Owner, TrialStore, counted_trials


@dataclass(frozen=True)
class Search:
    """A search to run.

    Attributes:
        study: name of the study.
        fixed: overrides that all trials share.
        identity: overrides of `fixed` that must not change in a study: all but paths.
    """

    study: str
    fixed: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    runs: RunStore
    identity: Sequence[Any]


def search(request: Search, settings: SweepSettings) -> None:
    """Run trials until the budget is spent, then report the study.

    Raises:
        InputError: settings that do not fit, or a study of that name with another space.
        RunError: no trial has finished.
    """
    if settings.trials is None and settings.hours is None:
        raise InputError(
            "a search needs a budget: hydra.sweeper.trials=40, hydra.sweeper.hours=8, or both."
        )
    if settings.retry == "failed":
        raise InputError(
            "retry=failed is for grids and tables. A search continues with other points: set more "
            "trials, or retries=1 to retry each failed point immediately."
        )
    sampler = build_sampler(settings.sampler, len(settings.objectives))
    first = settings.objectives[0]
    if settings.pruner is not None and not first.is_reported:
        raise InputError(
            f"pruner: it compares trials during training, but {first.metric} is known only at the "
            "end; choose val/mIoU or hydra.sweeper.pruner=null."
        )
    pruner = build_pruner(settings.pruner, len(settings.objectives))
    if settings.dry_run:
        _preview(request, settings)
        return
    probe = _probe(request, settings)
    storage = open_storage(settings.storage, request.runs.runs_dir)
    request.runs.create_tables()
    attributes = {
        names.KIND: "search",
        names.SIGNATURE: signature(
            request.parameters,
            settings.objectives,
            settings.replicates,
            [*request.identity, probe.dataset],
        ),
    }
    study = open_study(request.study, storage, settings.objectives, attributes, sampler, pruner)
    if names.COMMAND not in study.user_attrs:
        study.set_user_attr(names.COMMAND, command_line(sys.orig_argv))
    store = TrialStore(study, storage, Owner.this_process())
    info(f"study {request.study}: run the same command on other machines to share it.")
    _drive(request, settings, store)
    trials = store.trials()
    states = Counter(trial.state.name for trial in trials)
    for trial in [trial for trial in trials if trial.state.name == "FAIL"][:5]:
        info(f"trial {trial.number} failed: {trial.user_attrs.get(names.REASON)}")
    if trials and not states["COMPLETE"] and not states["RUNNING"]:
        raise RunError(f"no trial of {request.study} has finished; see the reasons above.")
    runs_dir = request.runs.runs_dir
    links = report(study, study_folder(runs_dir, request.study), request.runs.tracking)
    show_links([*links, ("dashboard", dashboard_command(settings.storage, runs_dir))])


def _probe(request: Search, settings: SweepSettings) -> RunSpec:
    """The run at the lowest point of the space; the highest one is checked too.

    Both refuse what the runs would: an end of a range that a setting does not accept, a missing
    data set, or an objective that the runs do not measure.
    """
    highest = specify_run((*request.fixed, *_end_of(request.parameters, "high")))
    planner = Planner()
    lowest = planner.specify((*request.fixed, *_end_of(request.parameters, "low")))
    planner.fingerprint(lowest)
    views = lowest.consistency.values
    measured = views["splits"] if views["sets"] else ()
    trainer = highest.trainer
    is_validated = trainer.tested == "best" or highest.dataset.build().has(trainer.selection_split)
    for objective in settings.objectives:
        split = objective.metric.partition("/")[0]
        if split == "val" and not is_validated:
            raise InputError(
                f"objective '{objective.metric}': the data set has no image of "
                f"{trainer.selection_split}, so the runs are not validated; hold images out, or "
                "choose test/..."
            )
        if objective.is_consistency and split not in measured:
            splits = ",".join(dict.fromkeys((split, "test")))
            raise InputError(
                f"objective '{objective.metric}': the runs do not measure it; add "
                f"consistency=views 'consistency.splits=[{splits}]'."
            )
    return lowest


def _end_of(parameters: tuple[Parameter, ...], end: Literal["low", "high"]) -> list[str]:
    """Overrides with every number at one end of its range, and the first of all choices."""
    from optuna.trial import FixedTrial

    values = {
        each.key: each.choices[0] if each.choices else getattr(each, end) for each in parameters
    }
    return list(as_overrides(suggest(FixedTrial(values), parameters)))


def _drive(request: Search, settings: SweepSettings, store: TrialStore) -> None:
    def num_done() -> int:
        return sum(trial.state.is_finished() for trial in store.trials())

    view = ProgressView(request.study, settings.trials, settings.workers, num_done)
    source = SamplerSource(
        request.fixed, request.parameters, store, Planner(), settings, view.rejected
    )
    drive(view, source, store, request.runs, settings)


def _preview(request: Search, settings: SweepSettings) -> None:
    """Print what would be searched and the existing trials; write nothing."""
    study = find_study(request.study, settings.storage, request.runs.runs_dir)
    trials = [] if study is None else counted_trials(study)
    states = Counter(trial.state.name.lower() for trial in trials)
    sys.stdout.write(f"study {request.study}: {dict(states) or 'not started'}\n")
    for parameter in request.parameters:
        sys.stdout.write(f"  {parameter}\n")
    for objective in settings.objectives:
        sys.stdout.write(f"  {objective.direction} {objective.metric}\n")
    sys.stdout.write(f"  python -m rgbt.run {command_line(request.fixed)} ...\n")
    if settings.trials is not None:
        left = max(0, settings.trials - len(trials))
        sys.stdout.write(f"{left} of {settings.trials} trials would be run.\n")
