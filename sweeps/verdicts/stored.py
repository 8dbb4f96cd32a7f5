"""Finished runs of a table's rows in a folder of runs, found without running anything."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
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

SEED = "rgbt.seed"


def finished_by_seed(runs_dir: Path) -> dict[int, set[str]]:
    """Keys of the finished runs of a folder by their seed; damaged runs are left out.

    Raises:
        InputError: there is no such folder.
    """
    found: dict[int, set[str]] = {}
    for folder in runs_in(runs_dir):
        run = RunResult(folder.path)
        with suppress(InputError, ValueError, TypeError):
            if run.is_finished:
                found.setdefault(int(run.tags[SEED]), set()).add(run.key)
    return found


def stored_runs(
    request: TableRequest,
    runs_dir: Path,
    finished: Mapping[int, Collection[str]],
    planner: Planner,
) -> dict[CellRunId, Outcome]:
    """The finished runs of every row; rows that cannot be composed have none.

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
    for row in request.trained_rows:
        try:
            spec = planner.specify((*planner.base, *request.overrides(row.label, 0)))
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
