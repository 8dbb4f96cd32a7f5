"""The sweep behind ``-m``: a grid of comma lists, a list of points, or a search."""

from __future__ import annotations

import hashlib
import json
import re
import shlex
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from omegaconf import DictConfig

from rgbt.checks import InputError, RunError
from rgbt.metrics import names
from rgbt.runs.provenance import without_passwords
from rgbt.tables import ABSENT, TextTable, number
from rgbt.terminal import info, print_rich, rich_table
from rgbt.tracking.mlflow_store import MlflowTracking
from sweeps.point import UNFINISHED, Outcome, Point
from sweeps.rendering.seed_groups import group_grid, unfinished_grid
from sweeps.report.study_data import short_names
from sweeps.search import Search, search
from sweeps.settings import SweepSettings, read_settings
from sweeps.space.grid import (
    GridPoint,
    distributions,
    grid_points,
    list_points,
    merge_space,
    split,
)
from sweeps.space.space import as_overrides
from sweeps.worker.executors import fork_template
from sweeps.worker.point_list import (
    PointList,
    estimated_seconds,
    other_code_line,
    preview_points,
    run_points,
)
from sweeps.worker.progress import duration
from sweeps.worker.run_store import open_run_store

PATHS = ("runs_dir", "dataset.root", "dataset.cache_dir", "tracking")
"""Overrides that may differ between two calls of the same sweep."""


def sweep(arguments: Sequence[str], config: DictConfig, loader: ConfigLoader) -> None:
    """Run the grid, list or search that the overrides of ``-m`` describe.

    Args:
        arguments: the task's overrides as typed.
        config: composed from them, with Hydra's own node.
        loader: of Hydra.

    Raises:
        InputError: invalid settings, space or points.
        RunError: points failed; all others were run.
    """
    settings = read_settings(config.hydra.sweeper)
    runs = open_run_store(config)
    if settings.executor == "local" and not settings.dry_run:
        fork_template(with_mlflow=isinstance(runs.tracking, MlflowTracking))
    # `fresh` is for the sweep, which decides for each point: no setting of its runs.
    arguments = [word for word in arguments if word.partition("=")[0] != "fresh"]
    # Text of `params` stands as it would be typed, other values as Hydra reads them.
    texts = {key: value for key, value in settings.params.items() if isinstance(value, str)}
    others = {key: value for key, value in settings.params.items() if key not in texts}
    typed = [f"{key}={value}" for key, value in texts.items()] + [*as_overrides(others)]
    fixed, swept, intervals = split([*typed, *arguments], loader)
    # Overrides of Hydra itself that a run needs too; without a sweep of its own.
    given = [word for word in config.hydra.overrides.hydra if "hydra.searchpath" in word]
    is_search = "search" in config.hydra.runtime.choices
    base = (*given, *(["hydra.mode=RUN"] if is_search else []))
    if settings.space or intervals:
        parameters = merge_space(settings.space, fixed, swept, intervals)
        taken = {parameter.key for parameter in parameters}
        shared = (*base, *(word for word in fixed if word.partition("=")[0] not in taken))
        if settings.points:
            raise InputError("points and a search cannot be combined; run them with two commands.")
        identity = (sorted(shared), parameters, settings.objectives, settings.replicates)
        name = settings.study or _name(config.name, [p.key for p in parameters], identity)
        search(Search(name, shared, parameters, runs, _plain(sorted(shared))), settings)
        return
    _refuse_search_settings(settings)
    grid = grid_points(fixed, swept)
    if settings.points:
        grid = [
            GridPoint({**each.params, **own.params}, own.overrides)
            for each in grid
            for own in list_points(settings.points, each.overrides)
        ]
    if len(grid) == 1:
        info("no list of values was given (such as seed=0,1,2); the sweep has one point.")
    name = settings.study or _name(config.name, list(grid[0].params), [p.overrides for p in grid])
    tags = {f"rgbt.study/{name}": "grid"}
    points = tuple(
        Point(_label(point) or name, point.overrides, params=point.params, tags=tags)
        for point in grid
    )
    kind = "list" if settings.points else "grid"
    _grid(PointList(name, name, kind, points, runs, base, distributions(grid)), settings)


def _label(point: GridPoint) -> str:
    """The varied values of a point, as typed: "sigma_div=1 seed=0"."""
    names = short_names([key.lstrip("+") for key in point.params])
    return " ".join(f"{names[key.lstrip('+')]}={value}" for key, value in point.params.items())


def _refuse_search_settings(settings: SweepSettings) -> None:
    given = {
        "trials": settings.trials is not None,
        "hours": settings.hours is not None,
        "pruner": settings.pruner is not None,
        "replicates": settings.replicates > 1,
    }
    for key in (key for key, is_given in given.items() if is_given):
        raise InputError(
            f"hydra.sweeper.{key} is for searches, but no key has a range; give a range "
            "(optimizer.lr=interval(0.001,0.01) or +search=...), or omit it."
        )


def study_command(study: str, runs_dir: Path, storage: str | None) -> str:
    """The command that reports a study, without passwords and default values."""
    words = ["rgbt", "study", f"name={study}"]
    words += [f"runs_dir={runs_dir}"] if runs_dir != Path("runs") else []
    words += [f"storage={without_passwords(storage)}"] if storage else []
    return shlex.join(words)


def _grid(points: PointList, settings: SweepSettings) -> None:
    if settings.dry_run:
        outcomes = preview_points(points, settings)
        print_rich(rich_table(grid_table(points, outcomes)))
        seconds = estimated_seconds(outcomes, settings.workers)
        missing = sum(outcome.state in UNFINISHED for outcome in outcomes)
        guess = "" if seconds is None else f", about {duration(seconds)}"
        info(f"{missing} of {len(outcomes)} points would be run{guess}.")
        _warn_other_code(outcomes)
        return
    # A typing error should not cost hours of other runs.
    outcomes = run_points(points, settings, strict=True)
    print_rich(rich_table(group_grid(points.title, outcomes)))
    unfinished = unfinished_grid(outcomes)
    if unfinished.rows:
        print_rich(rich_table(unfinished))
    _warn_other_code(outcomes)
    command = study_command(points.study, points.runs.runs_dir, settings.storage)
    info(f"study {points.study}; its figures: {command}")
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    if failed:
        raise RunError(
            f"{len(failed)} of {len(outcomes)} points failed, first {failed[0].point.label}: "
            f"{failed[0].reason} (hydra.sweeper.retry=failed retries them)."
        )


def _warn_other_code(outcomes: Sequence[Outcome]) -> None:
    line = other_code_line(outcomes)
    if line:
        info(line)


def grid_table(points: PointList, outcomes: Sequence[Outcome]) -> TextTable:
    """A preview, one row per point: its label, its scores on the test split, its state."""
    metrics = (names.MIOU, names.VAR)
    rows = []
    for outcome in outcomes:
        scores: Mapping[str, float] = (
            outcome.results[0].recorded_scores() if outcome.results else {}
        )
        shown = [f"test/{metric}" for metric in metrics]
        values = [number(scores[name]) if name in scores else ABSENT for name in shown]
        key = outcome.keys[0] if outcome.keys else ABSENT
        state = outcome.reason[:80] if outcome.reason else outcome.state
        rows.append((outcome.point.label, *values, key, state))
    return TextTable(points.title, ("point", *metrics, "run", "state"), tuple(rows))


def _name(experiment: str, keys: Sequence[str], identity: Any) -> str:
    """A reproducible name: the method, the varied keys, a hash of everything."""
    text = json.dumps(_plain(identity), sort_keys=True, default=vars)
    digest = hashlib.sha256(text.encode()).hexdigest()[:6]
    varied = "-".join(re.sub(r"[^\w-]", "", key.rpartition(".")[2]) for key in keys)
    return f"{experiment}-{varied[:60]}-{digest}" if varied else f"{experiment}-{digest}"


def _plain(value: Any) -> Any:
    """`value` without the overrides that are only paths."""
    if isinstance(value, str):
        key = value.partition("=")[0].lstrip("+")
        return None if key in PATHS or key.startswith("tracking.") else value
    if isinstance(value, list | tuple):
        return [plain for plain in map(_plain, value) if plain is not None]
    return value
