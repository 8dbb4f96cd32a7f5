"""Finished runs of a table's rows in a folder of runs, found without running anything."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

from analysis.uncertainty.verdicts import AnyTime, FixedSeeds, Rule
from rgbt.checks import InputError
from rgbt.runs.folder import runs_in
from rgbt.runs.result import RunResult
from sweeps.point import Outcome, Point
from sweeps.table.request import UNTIL_DECIDED, TableRequest
from sweeps.verdicts.judge import CellRunId
from sweeps.worker.planner import Planner

SEED, EXPERIMENT = "rgbt.seed", "rgbt.experiment"


def finished_by_seed(runs_dir: Path) -> dict[int, dict[str, str]]:
    """Seed -> key -> experiment of the finished runs of a folder; damaged runs are left out.

    Raises:
        InputError: there is no such folder.
    """
    found: dict[int, dict[str, str]] = {}
    for folder in runs_in(runs_dir):
        run = RunResult(folder.path)
        with suppress(InputError, KeyError, ValueError, TypeError):
            if run.is_finished:
                tags = run.tags
                found.setdefault(int(tags[SEED]), {})[run.key] = tags[EXPERIMENT]
    return found


def stored_runs(
    request: TableRequest,
    runs_dir: Path,
    finished: Mapping[int, Mapping[str, str]],
    planner: Planner,
) -> dict[CellRunId, Outcome]:
    """The finished runs of every row; rows that cannot be composed have none.

    A row is composed if a finished run is of its experiment, or if overrides are to be checked.

    Args:
        request: the table; its seeds do not matter.
        runs_dir: the folder of runs.
        planner: of the runs.
        finished: see `finished_by_seed`.

    Raises:
        InputError: no row can be composed.
    """
    runs: dict[CellRunId, Outcome] = {}
    errors = []
    known = {f"+experiment={name}" for keys in finished.values() for name in keys.values()}
    for row in request.trained_rows:
        words = request.overrides(row.label, 0)
        if not request.extra and words[0] not in known:
            continue
        try:
            spec = planner.specify((*planner.base, *words))
            keys = {seed: spec.with_seed(seed).key for seed in finished}
        except InputError as error:
            errors.append(error)
            continue
        for seed, key in sorted(keys.items()):
            if key in finished[seed]:
                runs[row.label, seed] = Outcome(
                    Point(row.label, ()), "finished", results=(RunResult(runs_dir / key),)
                )
    if errors and len(errors) == len(request.trained_rows):
        raise errors[0]  # of the command, and not of a row
    return runs


def rule_of(tags: Iterable[Mapping[str, str]]) -> Rule:
    """The rule that runs allow, by their tags: valid at any time where results decided how many.

    The tag of any table counts, because tables share runs.
    """
    tagged = any(name.startswith(UNTIL_DECIDED) for each in tags for name in each)
    return AnyTime() if tagged else FixedSeeds()
