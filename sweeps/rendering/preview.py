"""The preview of a table (`dry_run=true`): its runs with their states, the time left."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

from rgbt.tables import ABSENT, TextTable
from rgbt.terminal import print_rich, rich_table
from sweeps.point import Outcome, State
from sweeps.rendering.times import print_lines, time_lines
from sweeps.table.efficiency import SCALE
from sweeps.table.request import TableRequest
from sweeps.table.table import MEASURED
from sweeps.worker.point_list import estimated_seconds, other_code_line
from sweeps.worker.progress import duration

if TYPE_CHECKING:
    from sweeps.table_plan import TablePlan

STATES: tuple[State, ...] = ("finished", "running", "failed", "waiting")
TRAINED = "trained, not evaluated for all columns"


def print_previews(
    previews: Sequence[tuple[TablePlan, Sequence[Outcome]]], workers: int, *, is_all: bool
) -> None:
    """Print the preview of one table, or one line for each of all."""
    if is_all:
        requests = [(plan.request, outcomes) for plan, outcomes in previews]
        print_rich(rich_table(tables_grid(requests, workers)))
        return
    ((plan, outcomes),) = previews
    if outcomes:
        print_rich(rich_table(cells_grid(plan.request, outcomes)))
    lines = summary(plan.request, outcomes, workers)
    if plan.until_decided is not None:
        lines.append(most_line(len(plan.until_decided.most_runs()), outcomes, workers))
    lines += time_lines((), (each.point.overrides for each in outcomes), plan.planner)
    print_lines(lines)


def cells_grid(request: TableRequest, outcomes: Sequence[Outcome]) -> TextTable:
    """One line per run: state, seconds, key, the reason of a failure."""
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
    title = f"{request.name}, scale={request.scale}: runs of the cells"
    return TextTable(title, ("cell", "state", "seconds", "run", "reason"), tuple(rows))


def tables_grid(
    previews: Sequence[tuple[TableRequest, Sequence[Outcome]]], workers: int
) -> TextTable:
    """One line per table: rows, runs by state, estimated time."""
    rows = []
    for request, outcomes in previews:
        runnable = len({label for label, _ in request.row_seeds()})
        states = Counter(outcome.state for outcome in outcomes)
        counts = (str(states[state]) for state in STATES)
        seconds = estimated_seconds(outcomes, workers)
        known = "unknown" if seconds is None else duration(seconds)
        time = known if outcomes else ABSENT
        rows.append((request.name, f"{runnable} of {len(request.table.rows)}", *counts, time))
    header = ("table", "rows to run", *STATES, "time left")
    return TextTable("Runs of all tables", header, tuple(rows))


def summary(request: TableRequest, outcomes: Sequence[Outcome], workers: int) -> list[str]:
    """Sentences below the runs: numbers, time left, what needs no run."""
    states = Counter(outcome.state for outcome in outcomes)
    counted = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lines = [f"{len(outcomes)} runs: {counted or 'none'}."]
    left = len(outcomes) - states["finished"]
    if left:
        seconds = estimated_seconds(outcomes, workers)
        known = duration(seconds) if seconds is not None else "known when one run is finished"
        lines.append(f"Time left with workers={workers}: {known}.")
    lines += [line for line in (other_code_line(outcomes),) if line]
    lines += _evaluations(request, outcomes)
    for column in request.table.columns:
        if column.efficiency is not None:
            verb = "measured" if column.efficiency in MEASURED else "counted"
            lines.append(f"Column '{column.name}' is {verb} at scale={SCALE}, without any run.")
    return lines


def most_line(most: int, outcomes: Sequence[Outcome], workers: int) -> str:
    """What `seeds=until_decided` may cost beyond the runs that are listed."""
    further = most - len(outcomes)
    seconds = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
    time = f", {duration(further * median(seconds) / workers)}" if seconds else ""
    return (
        f"Until all claims are decided: at most {further} runs more than these{time}; rows of "
        "decided claims get no more."
    )


def _evaluations(request: TableRequest, outcomes: Sequence[Outcome]) -> list[str]:
    """Further evaluations of every run, and the number of runs that lack nothing else."""
    commands = [
        shlex.join(evaluation.command).replace("rgbt.", "rgbt ", 1)
        for evaluation in request.evaluations()
        if not evaluation.world
    ]
    worlds = {each.world: None for each in request.evaluations() if each.world}
    if worlds:
        commands.append(f"rgbt evaluate in {len(worlds)} worlds ({', '.join(worlds)})")
    if not outcomes or not commands:
        return []
    shown = "; ".join(dict.fromkeys(commands))
    lines = [f"Evaluations of every run that still lacks them: {shown}."]
    trained = sum(outcome.is_trained for outcome in outcomes)
    if trained:
        lines.append(f"Already trained: {trained}; the time left excludes their evaluations.")
    return lines
