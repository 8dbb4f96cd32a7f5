"""The preview of a table: ``dry_run=true``."""

from __future__ import annotations

import shlex
from collections import Counter
from collections.abc import Sequence
from statistics import median
from typing import TYPE_CHECKING

from rich.text import Text

from rgbt.tables import ABSENT, TextTable
from rgbt.terminal import print_rich, rich_table
from sweeps.point import Outcome, State
from sweeps.table.efficiency import SCALE
from sweeps.table.request import TableRequest
from sweeps.table.table import MEASURED
from sweeps.worker.point_list import estimated_seconds, other_code_line
from sweeps.worker.progress import duration

if TYPE_CHECKING:
    from sweeps.table_plan import TablePlan

STATES: tuple[State, ...] = ("finished", "running", "failed", "waiting")
TRAINED = "trained, not evaluated for all columns"


def print_preview(plan: TablePlan, outcomes: Sequence[Outcome], workers: int) -> None:
    """Print the runs of a table with their states, and what is left to do."""
    request = plan.request
    if outcomes:
        cells = tuple(
            (
                *(outcome.point.label, outcome.state),
                ABSENT if outcome.seconds is None else f"{outcome.seconds:.0f}",
                " ".join(outcome.keys) or ABSENT,
                outcome.reason or (TRAINED if outcome.is_trained else ""),
            )
            for outcome in outcomes
        )
        title = f"{request.name}, scale={request.scale}: runs of the cells"
        header = ("cell", "state", "seconds", "run", "reason")
        print_rich(rich_table(TextTable(title, header, cells)))
    lines = _summary(request, outcomes, workers)
    if plan.until_decided is not None:
        further = len(plan.until_decided.most_runs()) - len(outcomes)
        seconds = [outcome.seconds for outcome in outcomes if outcome.seconds is not None]
        time = f", {duration(further * median(seconds) / workers)}" if seconds else ""
        lines.append(
            f"Until all claims are decided: at most {further} runs more than these{time}; rows of "
            "decided claims get no more."
        )
    print_rich(Text("\n".join(lines)))


def _summary(request: TableRequest, outcomes: Sequence[Outcome], workers: int) -> list[str]:
    """Sentences below the runs: numbers, time left, further evaluations, what needs no run."""
    states = Counter(outcome.state for outcome in outcomes)
    counted = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lines = [f"{len(outcomes)} runs: {counted or 'none'}."]
    if len(outcomes) > states["finished"]:
        seconds = estimated_seconds(outcomes, workers)
        known = duration(seconds) if seconds is not None else "known when one run is finished"
        lines.append(f"Time left with workers={workers}: {known}.")
    lines += [line for line in (other_code_line(outcomes),) if line]
    evaluations = request.evaluations() if outcomes else ()
    words = (shlex.join(each.command) for each in evaluations if not each.world)
    commands = list(dict.fromkeys(each.replace("rgbt.", "rgbt ", 1) for each in words))
    worlds = list(dict.fromkeys(each.world for each in evaluations if each.world))
    if worlds:
        commands.append(f"rgbt evaluate in {len(worlds)} worlds ({', '.join(worlds)})")
    trained = sum(outcome.is_trained for outcome in outcomes)
    if commands:
        shown = "; ".join(commands)
        lines.append(f"Evaluations of every run that still lacks them: {shown}.")
    if commands and trained:
        lines.append(f"Already trained: {trained}; the time left excludes their evaluations.")
    for column in request.table.columns:
        if column.efficiency is not None:
            verb = "measured" if column.efficiency in MEASURED else "counted"
            lines.append(f"Column '{column.name}' is {verb} at scale={SCALE}, without any run.")
    return lines
