"""How a planned point stands, by its run folders and the log of its last job, and what it lacks."""

from __future__ import annotations

import json
from pathlib import Path

from rgbt.checks import RunError
from rgbt.config.compose import OWN_FOLDERS, own_folders
from rgbt.files.atomic import is_held
from rgbt.files.plain_files import inside
from rgbt.runs.naming import TAGS
from rgbt.runs.result import RunResult
from sweeps.plan.measurement import command_of, stored_at
from sweeps.plan.planner import PlannedPoint
from sweeps.point import Outcome
from sweeps.run.job import TRAINING, Work, failed_before
from sweeps.run.run_store import RunStore

LOGS = ".logs"  # folder in the folder of runs: output of jobs, one file a point
# Settings of a run that its evaluations get, too.
FOLDERS = ("dataset.root=", "dataset.cache_dir=")


def log_of(plan: PlannedPoint, runs: RunStore) -> Path:
    """Return the file with the output of a point's jobs; InputError for a link out of the runs."""
    return inside(runs.runs_dir / LOGS / f"{plan.key}.log", runs.runs_dir)


def evaluated_runs(
    plan: PlannedPoint, runs: RunStore, *, is_dry: bool = False
) -> tuple[RunResult, ...]:
    """Return the runs of a point if all are finished and evaluated, () otherwise.

    They get the tags of the point, unless it `is_dry`. RunError: one of them is of other images.
    """
    results = runs.of_point(plan)
    for result in results:
        if any(stored_at(result, words) is None for words in plan.point.evaluations):
            return ()
    for result in results:
        if not is_dry:
            runs.tag(result, plan.point.tags)
    return results


def stored_outcome(
    plan: PlannedPoint, runs: RunStore, *, is_retried: bool, is_dry: bool = False
) -> Outcome:
    """Return whether a point is finished, has failed, or waits to be executed.

    `is_retried`: what failed in an earlier job waits. `is_dry`: nothing is written.
    """
    try:
        results = evaluated_runs(plan, runs, is_dry=is_dry)
    except RunError:  # raised again when the point is executed
        results = ()
    if results:
        return plan.outcome("finished", results=results)
    reason = "" if is_retried else failed_before(log_of(plan, runs))
    return plan.outcome("failed" if reason else "waiting", reason)


def work_of(plan: PlannedPoint, runs: RunStore, trust: str) -> Work:
    """Return what a point lacks: trainings, and further evaluations of its runs.

    Finished runs of other code that ``fresh=true`` trains again are moved out of the way. RunError:
    a finished run is of other images.
    """
    steps = dict[tuple[str, ...], Path | None]()
    for run in plan.runs:
        folder = runs.runs_dir / run.key
        if not is_held(folder / "lock"):
            runs.replace_outdated(run.key)
        result = runs.find(run.key, plan.fingerprints[run.key], plan.point.evaluations)
        if result is None:
            steps[TRAINING, *run.overrides] = folder
        more = [f"trust={trust}"] if trust else []
        # The run may come from a machine with other folders.
        more += [word for word in run.overrides if word.startswith(FOLDERS)]
        for words in plan.point.evaluations:
            if result is None or stored_at(result, words) is None:
                module, *arguments = command_of(words)
                # One command may make several measurements.
                steps[module, f"run={folder}", *arguments, *more] = None
    environment = {TAGS: json.dumps(dict(plan.point.tags)), OWN_FOLDERS: own_folders()}
    return Work(plan.key, steps, environment, log_of(plan, runs), Path.cwd())
