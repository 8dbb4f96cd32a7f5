"""The sweep behind ``-m``: a grid of comma lists, a list of points, or a search.

In a search a sampler selects the points and a pruner stops bad ones.
"""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import optuna
from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig
from optuna.exceptions import StorageInternalError
from rich.console import Group

from rgbt.checks import InputError, RunError
from rgbt.runs.provenance import command_line
from rgbt.runs.run_spec import RunSpec
from rgbt.terminal import info, print_rich, rich_table
from sweeps import attributes as names
from sweeps import space as spaces
from sweeps.plan.planner import Planner, specify_run
from sweeps.point import Point, short_names
from sweeps.run import point_list
from sweeps.run.driver import drive
from sweeps.run.optuna_study import (
    driving,
    known_studies,
    open_storage,
    open_study,
    storage_url,
    study_folder,
)
from sweeps.run.point_list import PointList
from sweeps.run.progress import ProgressView, duration
from sweeps.run.run_store import RunStore, open_run_store
from sweeps.run.search_source import SearchSource
from sweeps.settings import SweepSettings, read_settings
from sweeps.show.seed_groups import group_grid, unfinished_grid
from sweeps.space import Space, as_overrides, build_pruner, build_sampler, key_of, signature
from sweeps.study import publish_study

# Beginnings of overrides that may differ between two calls of the same sweep.
PATHS = ("runs_dir", "dataset.root", "dataset.cache_dir", "tracking")

# Settings that have no effect on a grid or a list.
OF_SEARCHES = ("trials", "hours", "pruner", "storage")


def sweep(arguments: Sequence[str], config: DictConfig, loader: ConfigLoader) -> None:
    """Run the grid, list or search of ``-m``, whose overrides were typed and composed.

    InputError: invalid settings, space or points. RunError: points failed; all others were run.
    """
    settings = read_settings(config.hydra)
    runs = open_run_store(config)
    typed = []
    for key, value in settings.params.items():
        # Text of `params` stands as it would be typed, other values as Hydra reads them.
        typed.append(f"{key}={value}" if isinstance(value, str) else as_overrides({key: value})[0])
    # `fresh` is for the sweep, which decides for each point: no setting of its runs.
    typed += [word for word in arguments if word.partition("=")[0] != "fresh"]
    fixed, swept, intervals = spaces.split(typed, loader)
    # Overrides of Hydra itself that a run needs too; without a sweep of its own.
    base = [word for word in config.hydra.overrides.hydra if "hydra.searchpath" in word]
    base += ["hydra.mode=RUN"] if "search" in config.hydra.runtime.choices else []

    if settings.space or intervals:
        if settings.points:
            raise InputError("points and a search cannot be combined; run them with two commands.")
        space = spaces.merge_space(settings.space, fixed, swept, intervals)
        constants = (sorted(space.items()), settings.objectives, settings.replicates)
        identity = signature(_plain(sorted([*base, *fixed])), *constants)
        name = settings.study or _name(config.name, space, identity)
        search(Search(name, (*base, *fixed), space, runs, identity), settings)
        return

    unused = [key for key in OF_SEARCHES if getattr(settings, key) is not None]
    if settings.replicates > 1:
        unused.append("replicates")
    if unused:
        raise InputError(f"hydra.sweeper.{unused[0]} is for a search, but no key has a range.")
    grid = []
    for point in spaces.grid_points(fixed, swept):
        if not settings.points:
            grid.append(point)
        for own in spaces.list_points(settings.points, point.overrides):
            grid.append(replace(own, params={**point.params, **own.params}))
    identity = signature([_plain(point.overrides) for point in grid])
    name = settings.study or _name(config.name, list(grid[0].params), identity)
    tags = {f"rgbt.study/{name}": "grid"}
    points = tuple(replace(point, label=_label(point) or name, tags=tags) for point in grid)
    _run_grid(PointList(name, name, points, runs, Planner(base)), settings)


def _label(point: Point) -> str:
    """Return the varied values of a point, as typed: "sigma_div=1 seed=0"."""
    values = {key.lstrip("+"): value for key, value in point.params.items()}
    return " ".join(f"{name}={values[key]}" for key, name in short_names(values).items())


def _name(experiment: str, keys: Iterable[str], identity: str) -> str:
    """Return a reproducible name: the method, the varied keys, a hash of everything."""
    varied = "-".join(re.sub(r"[^\w-]", "", key.rpartition(".")[2]) for key in keys)
    return "-".join(word for word in (experiment, varied[:60], identity[:6]) if word)


def _plain(words: Sequence[str]) -> list[str]:
    """Return overrides without those that are only paths."""
    return [word for word in words if not key_of(word).startswith(PATHS)]


def _run_grid(points: PointList, settings: SweepSettings) -> None:
    if settings.commands is not None:
        info(point_list.commands_line(points, settings))
        return
    if settings.dry_run:
        outcomes = point_list.preview_points(points, settings)
    else:
        # A typing error should not cost hours of other runs.
        found = point_list.run_points(points, settings, strict=True)
        if found is None:
            return
        outcomes = found
    tables = [unfinished_grid(outcomes)]
    if any(outcome.results for outcome in outcomes):
        tables.insert(0, group_grid(points.title, outcomes))
    print_rich(Group(*(rich_table(table) for table in tables if table.rows)))
    if other_code := point_list.other_code_line(outcomes):
        info(other_code)
    if settings.dry_run:
        seconds = point_list.estimated_seconds(outcomes, settings.workers or 1)
        missing = len({outcome.keys for outcome in outcomes if outcome.state == "waiting"})
        guess = "" if seconds is None else f", about {duration(seconds)}"
        info(f"{missing} of {len(outcomes)} points would be run{guess}.")
        return
    failed = [outcome for outcome in outcomes if outcome.state in ("failed", "missing")]
    if failed:
        raise RunError(
            f"{len(failed)} of {len(outcomes)} points failed, first {failed[0].point.label}: "
            f"{failed[0].reason} (hydra.sweeper.retry=failed retries them)."
        )


@dataclass(frozen=True)
class Search:
    """Describes a search to run.

    `fixed` are overrides that all trials share; `identity` is a signature of what must not change
    in a study, to which the data set is added.
    """

    study: str
    fixed: tuple[str, ...]
    space: Space
    runs: RunStore
    identity: str


def search(request: Search, settings: SweepSettings) -> None:
    """Run trials until the budget is spent, then report the study.

    InputError: settings that do not fit, or a study of that name with another space. RunError: no
    trial has finished, or the storage cannot be reached any more.
    """
    if settings.trials is None and settings.hours is None:
        raise InputError("a search needs hydra.sweeper.trials=40, hydra.sweeper.hours=8, or both.")
    if settings.commands is not None:
        raise InputError("hydra.sweeper.commands is for grids, lists and tables: a search decides.")
    build_sampler(settings.sampler, 0)  # refuses wrong options before anything is written
    build_pruner(settings.pruner)
    is_reported = len(settings.objectives) == 1 and settings.objectives[0].is_reported
    if settings.pruner is not None and not is_reported:
        raise InputError("hydra.sweeper.pruner needs one objective that is reported, as val/mIoU.")
    runs_dir = request.runs.runs_dir
    url = storage_url(settings.storage, runs_dir, request.study)
    if settings.dry_run:
        known = known_studies(url, runs_dir).get(request.study)
        done = 0 if known is None else len(known.get_trials(deepcopy=False))
        total = settings.trials or "any number of"
        for key, distribution in request.space.items():
            sys.stdout.write(f"{key}: {distribution}\n")
        sys.stdout.write(f"study {request.study}: {done} of {total} trials exist.\n")
        return
    if settings.launcher in ("submitit_slurm", "ray") and settings.workers is None:
        raise InputError(
            f"a search with hydra/launcher={settings.launcher} needs hydra.sweeper.workers=8: "
            "how many trials are tried at once."
        )
    dataset = probe(request, settings).dataset
    attributes = {names.SIGNATURE: signature(request.identity, dataset)}
    with driving(runs_dir, request.study) as is_ours:
        if is_ours:
            study = open_study(request.study, open_storage(url), settings.objectives, attributes)
            _run_trials(request, settings, study)
            publish_study(study, study_folder(runs_dir, request.study), url)


def _run_trials(request: Search, settings: SweepSettings, study: optuna.Study) -> None:
    study.pruner = build_pruner(settings.pruner)
    if names.COMMAND not in study.user_attrs:
        study.set_user_attr(names.COMMAND, command_line(sys.orig_argv))
    view = ProgressView(request.study)
    source = SearchSource(request.fixed, request.space, study, settings, request.runs, view.say)
    try:
        drive(view, source, request.runs, settings)
    except StorageInternalError as error:
        raise RunError(f"storage: {str(error).splitlines()[0]}; rerun the command.") from error

    trials = study.get_trials(deepcopy=False)
    states = Counter(trial.state.name for trial in trials)
    for trial in [trial for trial in trials if trial.state.name == "FAIL"][:5]:
        info(f"trial {trial.number} failed: {trial.user_attrs.get(names.REASON)}")
    if trials and not states["COMPLETE"] and not states["RUNNING"]:
        raise RunError(f"no trial of {request.study} has finished; see the reasons above.")


def probe(request: Search, settings: SweepSettings) -> RunSpec:
    """Return the run at the lowest point of the space; the highest one is checked too.

    Both refuse what the runs would: an end of a range that a setting does not accept, a missing
    data set, or an objective that the runs do not measure.
    """
    planner = Planner()
    low, high = spaces.ends(request.space)
    lowest = planner.specify((*request.fixed, *low))
    highest = specify_run((*request.fixed, *high))
    planner.fingerprint(lowest)
    views, trainer = lowest.consistency.values, highest.trainer
    measured = views["splits"] if views["sets"] else ()
    is_validated = trainer.tested == "best" or highest.dataset.build().has(trainer.selection_split)
    for objective in settings.objectives:
        split, why = objective.metric.partition("/")[0], ""
        if split == "val" and not is_validated:
            why = f"the data set has no {trainer.selection_split}; hold images out, or use test/..."
        if objective.is_consistency and split not in measured:
            why = f"not measured; add consistency=views and {split} to consistency.splits."
        if why:
            raise InputError(f"objective '{objective.metric}': {why}")
    return lowest
