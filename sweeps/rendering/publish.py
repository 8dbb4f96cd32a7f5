"""Prints a computed table and writes its files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group

from rgbt.files.atomic import write_atomic
from rgbt.tables import TextTable
from rgbt.terminal import info, path_lines, print_rich, rich_table
from sweeps.point import Outcome
from sweeps.rendering.claims import claim_grids, claims_csv, claims_frame, claims_markdown, counted
from sweeps.rendering.effects import effects_csv, effects_figure, effects_grids
from sweeps.rendering.figure import figure_of, write_figure
from sweeps.rendering.table import MARKDOWN, TERMINAL, Style, latex, render_table, tidy_csv
from sweeps.table.cells import NO_VALUE
from sweeps.table.efficiency import efficiency_cells
from sweeps.table.request import TableRequest
from sweeps.verdicts.judge import CellRunId, TableJudge
from sweeps.verdicts.stored import TableResult
from sweeps.worker.point_list import other_code_line

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def publish_table(
    judge: TableJudge,
    request: TableRequest,
    outcomes: Sequence[Outcome],
    external: Mapping[CellRunId, Outcome],
    out: Path,
) -> int:
    """Print the table and its claims, and write its files into `out`.

    Args:
        judge: of the table.
        request: the table.
        outcomes: of its points.
        external: runs of rows that are not trained.
        out: folder of the files.

    Returns:
        1 where a cell failed or has no value, or the files could not be written; else 0.
    """
    runs: dict[CellRunId, Outcome] = {**request.runs(outcomes), **external}
    result = TableResult.of(request, runs, judge, efficiency_cells(request))
    shown = grid_of(result, TERMINAL)
    claims = claims_frame(result.claims)
    grids = [shown, *grids_of(result), *claim_grids(claims, narrow=True)]
    print_rich(Group(*map(rich_table, grids)))
    failed = _report_missing(result, outcomes)
    if len(claims):
        print_rich(counted(claims))
    texts = {
        "table.md": markdown_of(result),
        "table.csv": tidy_csv(result.scored),
        "table.tex": latex(shown),
    }
    texts |= {"claims.csv": claims_csv(claims)} if len(claims) else {}
    if result.effects is not None:
        texts["effects.csv"] = effects_csv(result.effects.lines)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_atomic(out / name, text.encode())
        drawn = drawn_of(result)
        figures = [] if drawn is None else [write_figure(drawn, out / "figure.png")]
    except OSError as error:
        info(f"{error.filename or out}: {error.strerror or error}; the files were not written.")
        return 1
    files = ", ".join([*texts, *(path.name for path in figures)])
    print_rich(path_lines([("files", f"{out}/ ({files})")]))
    return 1 if failed else 0


def grid_of(result: TableResult, style: Style) -> TextTable:
    """The grid of a table with all that was typed for it."""
    request = result.request
    words = [word for word in request.typed if word.startswith(("weights.", "predictions."))]
    spread = "so that their spread over trainings is not known"
    remarks = [f"Not trained here, {spread}: {'; '.join(words)}."] if words else []
    return render_table(result.scored, style, request.typed_overrides(), remarks)


def grids_of(result: TableResult) -> list[TextTable]:
    """Differences of the forms, and effects of the design, as far as there are any."""
    design = result.request.table.design
    forms = [] if result.forms is None else [result.forms]
    effects = result.effects if design is not None else None
    return forms if effects is None or design is None else [*forms, *effects_grids(effects, design)]


def markdown_of(result: TableResult) -> str:
    """The table, the forms, the effects and the claims in Markdown."""
    grids = [grid_of(result, MARKDOWN), *grids_of(result)]
    parts = [grid.to_markdown() for grid in grids]
    parts += [claims_markdown(claims_frame(result.claims))] if result.claims else []
    return "\n".join(parts)


def drawn_of(result: TableResult) -> Figure | None:
    """The figure of a table, of a design that of its effects; None: there is nothing to draw."""
    if result.effects is not None:
        return effects_figure(result.effects, result.scored.name)
    return figure_of(result.scored)


def _report_missing(result: TableResult, outcomes: Sequence[Outcome]) -> bool:
    """Lines on stderr; whether a cell failed or has no value."""
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    others = [outcome for outcome in outcomes if outcome.state in ("running", "waiting")]
    empty = any(cell.mark == NO_VALUE for cell in result.scored.cells.values())
    if failed:
        info(
            f"{len(failed)} of {len(outcomes)} runs failed, see the footnotes; rerun the command "
            "with retry=failed to retry them."
        )
    if others:
        info(
            f"{len(others)} of {len(outcomes)} runs are not finished: other commands run them, or "
            "they have not started; rerun the command later, or with wait=true."
        )
    if empty:
        info("some cells have no value although all runs are finished; see the footnotes.")
    other = other_code_line(outcomes)
    if other:
        info(other)
    return bool(failed) or empty
