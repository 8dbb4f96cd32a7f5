"""A search: a sampler chooses the points, bad ones are pruned, any number of drivers share it."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from rgbt.checks import InputError, RunError
from rgbt.tracking.provenance import command_line
from rgbt.tracking.terminal import tell
from sweeps import attributes as names
from sweeps.points import Point
from sweeps.settings import Settings
from sweeps.space.samplers import build_pruner, build_sampler
from sweeps.space.space import Parameter, as_overrides, signature, suggest
from sweeps.study import dashboard_command, report, show_places, study_folder
from sweeps.worker.driver import Driver
from sweeps.worker.found import Runs
from sweeps.worker.lists import make_executor
from sweeps.worker.live import View
from sweeps.worker.owner import Owner
from sweeps.worker.plan import Plan, Planner
from sweeps.worker.sources import SearchSource
from sweeps.worker.storage import begin_study, existing_study, open_storage
from sweeps.worker.trial_store import Ledger, counted


@dataclass(frozen=True)
class Search:
    """What is searched.

    Attributes:
        study: name of the study.
        fixed: overrides that all trials share.
        parameters: the space.
        runs: where finished runs are found.
        identity: what of `fixed` must not change in a study: all but where things lie.
    """

    study: str
    fixed: tuple[str, ...]
    parameters: tuple[Parameter, ...]
    runs: Runs
    identity: Sequence[Any]


def search(wanted: Search, settings: Settings) -> None:
    """Run trials until the budget is spent, then show what was found.

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
            "retry=failed is for grids and tables; a search goes on with other points: give it "
            "more trials, or retries=1 to try each failed point again at once."
        )
    sampler, pruner = _sampler_and_pruner(settings)
    if settings.dry_run:
        _preview(wanted, settings)
        return
    probe = _probe(wanted)
    _check_consistency(probe, settings)
    storage = open_storage(settings.storage, wanted.runs.runs_dir)
    wanted.runs.touch()
    attributes = {
        names.KIND: "search",
        names.SIGNATURE: signature(
            wanted.parameters,
            settings.objectives,
            settings.replicates,
            [*wanted.identity, probe.runs[0].dataset],
        ),
    }
    study = begin_study(wanted.study, storage, settings.objectives, attributes, sampler, pruner)
    if names.COMMAND not in study.user_attrs:
        study.set_user_attr(names.COMMAND, command_line(sys.orig_argv))
    ledger = Ledger(study, storage, Owner.me())
    tell(f"study {wanted.study}: the same command on other machines takes part in it.")
    _drive(wanted, settings, ledger)
    _check_end(ledger, wanted.study)
    runs_dir = wanted.runs.runs_dir
    links = report(study, study_folder(runs_dir, wanted.study), wanted.runs.tracking)
    show_places([*links, ("dashboard", dashboard_command(settings.storage, runs_dir))])


def _probe(wanted: Search) -> Plan:
    """The lowest point of the space, checked with the highest one before the first trial.

    Raises:
        InputError: an end that a setting does not take, a point that cannot be composed, or no
            data set.
    """
    planner = Planner()
    planner.spec((*wanted.fixed, *_end_of(wanted.parameters, "high")))
    lowest = (*wanted.fixed, *_end_of(wanted.parameters, "low"))
    return planner.plan(Point(label="probe", overrides=lowest))


def _end_of(parameters: tuple[Parameter, ...], end: Literal["low", "high"]) -> list[str]:
    """Overrides with every number at one end of its range, and the first of all choices."""
    from optuna.trial import FixedTrial

    values = {
        each.key: each.choices[0] if each.choices else getattr(each, end) for each in parameters
    }
    return list(as_overrides(suggest(FixedTrial(values), parameters)))


def _check_consistency(probe: Plan, settings: Settings) -> None:
    """Refuse an objective of two frames that the runs would not measure.

    Raises:
        InputError: the split is not among those of ``conf/consistency``.
    """
    for objective in filter(lambda each: each.is_consistency, settings.objectives):
        views = Planner().spec(probe.runs[0].overrides).consistency.values
        split = objective.metric.partition("/")[0]
        if not views["sets"] or split not in views["splits"]:
            splits = ",".join(dict.fromkeys((split, "test")))
            raise InputError(
                f"objective '{objective.metric}': the runs do not measure it; add "
                f"consistency=views 'consistency.splits=[{splits}]'."
            )


def _drive(wanted: Search, settings: Settings, ledger: Ledger) -> None:
    def done() -> int:
        return sum(trial.state.is_finished() for trial in ledger.trials())

    view = View(wanted.study, settings.trials, settings.workers, done)
    source = SearchSource(
        wanted.fixed, wanted.parameters, ledger, Planner(), settings, view.refused
    )
    driver = Driver(
        ledger=ledger,
        source=source,
        runs=wanted.runs,
        executor=make_executor(settings, wanted.runs.runs_dir),
        settings=settings,
        view=view,
        metrics=[objective.metric for objective in settings.objectives],
    )
    with view:
        driver.run()


def _sampler_and_pruner(settings: Settings) -> tuple[Any, Any]:
    count = len(settings.objectives)
    kind, seed, options = _chosen(settings.sampler, "sampler")
    sampler = build_sampler(kind, seed, options, count)
    if settings.pruner is None:
        return sampler, build_pruner("none", {}, count)
    kind, _, options = _chosen(settings.pruner, "pruner")
    if not settings.objectives[0].is_followed:
        raise InputError(
            f"pruner: trials are compared while they train, but {settings.objectives[0].metric} is "
            "known at the end alone; follow val/mIoU or take hydra.sweeper.pruner=null."
        )
    return sampler, build_pruner(kind, options, count)


def _chosen(node: Mapping[str, Any], what: str) -> tuple[str, int, dict[str, Any]]:
    options = {key: value for key, value in node.items() if key not in ("kind", "seed")}
    if "kind" not in node:
        raise InputError(f"hydra.sweeper.{what}: 'kind' has no value, such as {{kind: tpe}}.")
    seed = node.get("seed", 0)
    if not isinstance(seed, int):
        raise InputError(f"hydra.sweeper.{what}.seed: expected a whole number, got {seed}.")
    return str(node["kind"]), seed, options


def _preview(wanted: Search, settings: Settings) -> None:
    """Say what would be searched, and what there is; write nothing."""
    study = existing_study(wanted.study, settings.storage, wanted.runs.runs_dir)
    trials = [] if study is None else counted(study)
    states = Counter(trial.state.name.lower() for trial in trials)
    sys.stdout.write(f"study {wanted.study}: {dict(states) or 'not begun'}\n")
    for parameter in wanted.parameters:
        sys.stdout.write(f"  {parameter}\n")
    for objective in settings.objectives:
        sys.stdout.write(f"  {objective.direction} {objective.metric}\n")
    sys.stdout.write(f"  python -m rgbt.run {command_line(wanted.fixed)} ...\n")
    if settings.trials is not None:
        left = max(0, settings.trials - len(trials))
        sys.stdout.write(f"{left} of {settings.trials} trials would be run.\n")


def _check_end(ledger: Ledger, name: str) -> None:
    trials = ledger.trials()
    states = Counter(trial.state.name for trial in trials)
    failed = [trial for trial in trials if trial.state.name == "FAIL"]
    for trial in failed[:5]:
        tell(f"trial {trial.number} failed: {trial.user_attrs.get(names.REASON)}")
    if trials and not states["COMPLETE"] and not states["RUNNING"]:
        raise RunError(f"no trial of {name} has finished; see the reasons above.")
