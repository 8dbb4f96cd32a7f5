"""What `dry_run=true` shows of a table: its cells, what is known of them, the time left."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence

from rgbt.tracking.tables import ABSENT, Grid
from sweeps.table.parameter_counts import SCALE
from sweeps.table.request import TableRequest
from sweeps.worker.point_list import Outcome, estimated_seconds, other_code_line
from sweeps.worker.progress import duration
from sweeps.worker.trial_source import State

STATES: tuple[State, ...] = ("finished", "running", "failed", "waiting")
TRAINED = "trained, not evaluated for all columns"


def cells_grid(wanted: TableRequest, outcomes: Sequence[Outcome]) -> Grid:
    """One line per run: state, seconds or the reason why it failed, command."""
    rows = [
        (
            outcome.point.label,
            outcome.state,
            ABSENT if outcome.seconds is None else f"{outcome.seconds:.0f}",
            " ".join(outcome.keys) or ABSENT,
            outcome.reason or (TRAINED if outcome.is_trained else ""),
        )
        for outcome in outcomes
    ]
    title = f"{wanted.name}, scale={wanted.scale}: runs of the cells"
    return Grid(title, ("cell", "state", "seconds", "run", "reason"), tuple(rows))


def tables_grid(surveyed: Sequence[tuple[TableRequest, Sequence[Outcome]]], workers: int) -> Grid:
    """One line per table: rows, runs by state, estimated time."""
    rows = []
    for wanted, outcomes in surveyed:
        runnable = len({label for label, _ in wanted.places()})
        states = Counter(outcome.state for outcome in outcomes)
        counts = (str(states[state]) for state in STATES)
        seconds = estimated_seconds(outcomes, workers)
        known = "unknown" if seconds is None else duration(seconds)
        time = known if outcomes else ABSENT
        rows.append((wanted.name, f"{runnable} of {len(wanted.table.rows)}", *counts, time))
    header = ("table", "rows to run", *STATES, "time left")
    return Grid("Runs of all tables", header, tuple(rows))


def summary(wanted: TableRequest, outcomes: Sequence[Outcome], workers: int) -> list[str]:
    """Sentences below the cells: how many, how long, what cannot be run."""
    states = Counter(outcome.state for outcome in outcomes)
    counted = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lines = [f"{len(outcomes)} runs: {counted or 'none'}."]
    left = len(outcomes) - states["finished"]
    if left:
        seconds = estimated_seconds(outcomes, workers)
        known = duration(seconds) if seconds is not None else "known once a run is finished"
        lines.append(f"Time left with workers={workers}: {known}.")
    lines += [line for line in (other_code_line(outcomes),) if line]
    lines += _evaluations(wanted, outcomes)
    if wanted.table.needs is not None:
        lines.append(f"The table cannot be run yet; it needs {wanted.table.needs}.")
    for row in wanted.table.rows:
        if row.needs is not None:
            lines.append(f"Row '{row.label}' cannot be run yet; it needs {row.needs}.")
    for column in wanted.table.columns:
        if column.needs is not None:
            lines.append(f"Column '{column.name}' is not computed yet; it needs {column.needs}.")
        if column.parameters:
            lines.append(f"Column '{column.name}' is counted at scale={SCALE}, without any run.")
    return lines


def _evaluations(wanted: TableRequest, outcomes: Sequence[Outcome]) -> list[str]:
    """What is made of every run beside its own evaluation, and which runs lack nothing else."""
    asked = [shlex.join(evaluation.command) for evaluation in wanted.evaluations()]
    if not outcomes or not asked:
        return []
    commands = "; ".join(f"python -m {command}" for command in dict.fromkeys(asked))
    lines = [f"Made of every run that lacks it: {commands}."]
    trained = sum(outcome.is_trained for outcome in outcomes)
    if trained:
        lines.append(f"Trained already: {trained}; the time of evaluations is not counted.")
    return lines
