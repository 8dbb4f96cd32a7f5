"""Says before the first run of a table starts what all of them need: time, disk, files."""

from __future__ import annotations

import json
import sys
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median

from rich.console import Console, Group

from rgbt.checks import InputError
from rgbt.runs.needs import checkpoint_bytes, free_bytes, in_gb
from rgbt.runs.run_spec import RunSpec
from rgbt.runs.starts import SIZES
from rgbt.tables import ABSENT, TextTable
from rgbt.terminal import plain_text, print_rich, rich_table, warn
from sweeps.plan.planner import Planner
from sweeps.plan.request import TableRequest
from sweeps.point import Outcome, Point, State
from sweeps.run.point_list import other_code_line
from sweeps.run.progress import duration

STATES: tuple[State, ...] = ("finished", "running", "failed", "missing", "waiting")
LEFT: tuple[State, ...] = ("failed", "missing", "waiting")  # what a call runs, once it can
TRAINED = "trained, not evaluated for all columns"
WIDTH = 120  # columns of a preview in a file
LABEL = 40  # of them for a label, which stays one line
MISSING = "Missing: without weights, a row starts at random; without data or checkout, not at all"


def seconds_a_step(outcomes: Sequence[Outcome], planner: Planner) -> dict[str, float]:
    """Return the median duration of a step of finished runs, by their kind (`kind_of`)."""
    found: dict[str, list[float]] = defaultdict(list)
    for outcome in outcomes:
        run = planner.composed(outcome.point)
        if run is not None and outcome.seconds is not None:
            found[kind_of(run)].append(outcome.seconds / run.plain["trainer"]["max_steps"])
    return {kind: median(values) for kind, values in found.items()}


def kind_of(run: RunSpec) -> str:
    """Return what decides the duration of a step: network with sizes, scheme, batch and images."""
    plain = run.plain
    sizes = [plain["model"].get(key) for key in SIZES]
    parts = (sizes, plain["scheme"]["_target_"], plain["data"]["batch_size"], plain["scale"])
    return json.dumps(parts)


def expected_s(run: RunSpec | None, step_s: Mapping[str, float]) -> float | None:
    """Return the expected duration of a run; None where no run of its kind has finished."""
    known = None if run is None else step_s.get(kind_of(run))
    return None if run is None or known is None else known * run.plain["trainer"]["max_steps"]


def pending_bytes(run: RunSpec | None) -> dict[str, int]:
    """Return the bytes of the checkpoints that a run and those upstream will write, by their key.

    {} where a setting is wrong, or the code of a network is not here.
    """
    found: dict[str, int] = {}
    try:
        for spec in run.pending if run is not None else ():
            size = checkpoint_bytes(spec)
            if size is not None:
                found[spec.key] = size
    except InputError:
        return {}
    return found


def short_label(point: Point) -> str:
    """Return the label of a row, cut to one line, with its seed."""
    row, _, seed = point.label.rpartition(" ")
    cut = row if len(row) <= LABEL else f"{row[: LABEL - 1]}…"
    return f"{cut} {seed}".strip()


def time_and_disk(
    point: Point, planner: Planner, step_s: Mapping[str, float]
) -> tuple[str, str, str]:
    """Return expected time, bytes of checkpoints and kinds of what is missing, in words."""
    run = planner.composed(point)
    seconds, sizes = expected_s(run, step_s), pending_bytes(run)
    return (
        ABSENT if seconds is None else duration(seconds),
        in_gb(sum(sizes.values())) if sizes else ABSENT,
        ", ".join(planner.lacking(point)),
    )


def need_lines(
    outcomes: Sequence[Outcome], planner: Planner, runs_dir: Path, workers: int
) -> Group:
    """Sum up time and disk of all runs that are left, and list what is missing; warn of the disk.

    Equal runs, and those that several rows depend on, count once.
    """
    left = [outcome for outcome in outcomes if outcome.state in LEFT]
    step_s = seconds_a_step(outcomes, planner)
    seconds: dict[tuple[str, ...], float | None] = {}
    sizes: dict[str, int] = {}
    missing: Counter[tuple[str, str]] = Counter()
    for outcome in left:
        point = outcome.point
        if point.overrides in seconds:
            continue
        run = planner.composed(point)
        seconds[point.overrides] = 0.0 if outcome.is_trained else expected_s(run, step_s)
        sizes |= {} if outcome.is_trained else pending_bytes(run)
        missing.update(planner.lacking(point).items())
    lines = []
    if left:
        lines.append(f"Time with workers={workers}: {_time(list(seconds.values()), workers)}.")
        needed, free = sum(sizes.values()) + max(sizes.values(), default=0), free_bytes(runs_dir)
        lines.append(
            f"Disk: {in_gb(needed)} of checkpoints, one of them written twice at a time; "
            f"{in_gb(free)} are free in {runs_dir}."
        )
        if needed > free:
            warn(f"checkpoints need {in_gb(needed)}, but {runs_dir} has {in_gb(free)} free.")
    parts = [plain_text("\n".join(lines))] if lines else []
    if not missing:
        return Group(*parts)
    rows = [(kind, what, str(number)) for (kind, what), number in missing.items()]
    table = TextTable(MISSING, ("kind", "what", "runs"), tuple(sorted(rows)))
    return Group(*parts, rich_table(table))


def print_needs(
    outcomes: Sequence[Outcome], planner: Planner, runs_dir: Path, workers: int
) -> None:
    """Print `need_lines` on stderr, where the progress of the runs follows."""
    width = None if sys.stderr.isatty() else WIDTH
    Console(stderr=True, width=width).print(need_lines(outcomes, planner, runs_dir, workers))


def _time(seconds: Sequence[float | None], workers: int) -> str:
    known = [value for value in seconds if value is not None]
    if not known:
        return "known after the first run"
    total = f"{duration(sum(known) / workers)}, without upstream runs and further evaluations"
    others = len(seconds) - len(known)
    unlike = f"; of {others} runs it is known after the first of their kind" if others else ""
    return f"{total}{unlike}"


def print_preview(
    request: TableRequest, outcomes: Sequence[Outcome], planner: Planner, workers: int, runs: Path
) -> None:
    """Print the runs of a table with their states and needs, and what is left to do."""
    parts = []
    if outcomes:
        step_s = seconds_a_step(outcomes, planner)
        rows = [_preview_row(outcome, planner, step_s) for outcome in outcomes]
        title = f"{request.name}, scale={request.scale}: runs of the cells"
        header = ("cell", "state", "time", "disk", "run", "missing or reason")
        parts.append(rich_table(TextTable(title, header, tuple(rows))))
    states = Counter(outcome.state for outcome in outcomes)
    counts = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lines = [f"{len(outcomes)} runs: {counts or 'none'}.", other_code_line(outcomes)]
    parts.append(plain_text("\n".join(filter(None, lines))))
    print_rich(Group(*parts, need_lines(outcomes, planner, runs, workers)), width=WIDTH)


def _preview_row(
    outcome: Outcome, planner: Planner, step_s: Mapping[str, float]
) -> tuple[str, ...]:
    time, disk, missing = time_and_disk(outcome.point, planner, step_s)
    if outcome.state not in LEFT or outcome.is_trained:
        known = outcome.seconds
        time, disk, missing = ABSENT if known is None else duration(known), ABSENT, ""
    reason = outcome.reason if outcome.state == "failed" else missing
    keys = " ".join(outcome.keys) or ABSENT
    note = TRAINED if outcome.is_trained else reason
    return (short_label(outcome.point), outcome.state, time, disk, keys, note)
