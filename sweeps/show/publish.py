"""Prints a table, its preview (``dry_run=true``) and what is missing, and writes its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group
from rich.text import Text

from rgbt.files.atomic import write_atomic
from rgbt.tables import ABSENT, TextTable
from rgbt.terminal import info, path_lines, print_rich, rich_table
from sweeps.judge.stored_tables import TableResult
from sweeps.point import Outcome, State
from sweeps.run.point_list import estimated_seconds, other_code_line
from sweeps.run.progress import duration
from sweeps.score.cells import NO_VALUE
from sweeps.show.claims import claim_grids, claims_frame, claims_markdown, counted, frame_csv
from sweeps.show.effects import effects_figure, effects_grids
from sweeps.show.figure import figure_of
from sweeps.show.table import MARKDOWN, TERMINAL, Style, latex, render_table, tidy_csv

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sweeps.plan.request import TableRequest

STATES: tuple[State, ...] = ("finished", "running", "failed", "waiting")
TRAINED = "trained, not evaluated for all columns"


def publish_table(result: TableResult, outcomes: Sequence[Outcome], out: Path) -> int:
    """Print the table and its claims, and write its files into `out`.

    Returns:
        1 where a cell failed or has no value, or the files could not be written; else 0.
    """
    shown = grid_of(result, TERMINAL)
    claims = claims_frame(result.claims)
    effects = grids_of(result)
    print_rich(Group(*map(rich_table, [shown, *effects, *claim_grids(claims, noted=True)])))
    failed = _report_missing(result, outcomes)
    if len(claims):
        print_rich(counted(claims))
    parts = [grid.to_markdown() for grid in (grid_of(result, MARKDOWN), *effects)]
    parts += [claims_markdown(claims)] if len(claims) else []
    texts = {
        "table.md": "\n".join(parts),
        "table.csv": tidy_csv(result.scored),
        "table.tex": latex(shown),
    }
    texts |= {"claims.csv": frame_csv(claims)} if len(claims) else {}
    if result.effects is not None:
        texts["effects.csv"] = frame_csv(result.effects.frame)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_atomic(out / name, text.encode())
        if drawn := drawn_of(result):
            from analysis.figures.plots import save

            save(drawn, out / "figure.png")
    except OSError as error:
        info(f"{error.filename or out}: {error.strerror or error}; the files were not written.")
        return 1
    files = ", ".join([*texts, *(["figure.png"] if drawn else [])])
    print_rich(path_lines([("files", f"{out}/ ({files})")]))
    return 1 if failed else 0


def grid_of(result: TableResult, style: Style) -> TextTable:
    """The grid of a table with all that was typed for it."""
    request = result.request
    words = [word for word in request.typed if word.startswith(("weights.", "predictions."))]
    spread = "so that their spread over trainings is not known"
    remarks = [f"Not trained here, {spread}: {'; '.join(words)}."] if words else []
    typed = (*request.typed_overrides(), *result.words)
    return render_table(result.scored, style, typed, remarks)


def grids_of(result: TableResult) -> list[TextTable]:
    """Effects of the design, if the table has one."""
    design = result.request.table.design
    return [] if result.effects is None or design is None else effects_grids(result.effects, design)


def drawn_of(result: TableResult) -> Figure | None:
    """The figure of a table, of a design that of its effects; None: there is nothing to draw."""
    if result.effects is not None:
        return effects_figure(result.effects, result.scored.name)
    return figure_of(result.scored)


def _report_missing(result: TableResult, outcomes: Sequence[Outcome]) -> bool:
    """Lines on stderr; whether a cell failed or has no value."""
    states = Counter(outcome.state for outcome in outcomes)
    if failed := states["failed"]:
        info(
            f"{failed} of {len(outcomes)} runs failed, see the footnotes; rerun with retry=failed."
        )
    if others := states["running"] + states["waiting"]:
        info(f"{others} of {len(outcomes)} runs are not finished; rerun the command later.")
    if other := other_code_line(outcomes):
        info(other)
    return failed > 0 or any(cell.mark == NO_VALUE for cell in result.scored.cells.values())


def print_preview(request: TableRequest, outcomes: Sequence[Outcome], workers: int) -> None:
    """Print the runs of a table with their states, and what is left to do."""
    if outcomes:
        cells = tuple(
            (
                outcome.point.label,
                outcome.state,
                ABSENT if outcome.seconds is None else f"{outcome.seconds:.0f}",
                " ".join(outcome.keys) or ABSENT,
                outcome.reason or (TRAINED if outcome.is_trained else ""),
            )
            for outcome in outcomes
        )
        title = f"{request.name}, scale={request.scale}: runs of the cells"
        header = ("cell", "state", "seconds", "run", "reason")
        print_rich(rich_table(TextTable(title, header, cells)))
    states = Counter(outcome.state for outcome in outcomes)
    counted = ", ".join(f"{states[state]} {state}" for state in STATES if states[state])
    lines = [f"{len(outcomes)} runs: {counted or 'none'}."]
    if len(outcomes) > states["finished"]:
        left = estimated_seconds(outcomes, workers)
        known = duration(left) if left is not None else "known when one run is finished"
        lines.append(f"Time left with workers={workers}, without further evaluations: {known}.")
    lines += filter(None, [other_code_line(outcomes)])
    print_rich(Text("\n".join(lines)))
