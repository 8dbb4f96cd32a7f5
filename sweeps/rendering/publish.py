"""Prints a computed table, writes its files and records it in MLflow."""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.files.atomic import write_atomic
from rgbt.tracking.terminal import info, line_width, path_lines, print_rich
from sweeps.rendering.figure import draw_table
from sweeps.rendering.file_formats import latex, markdown, tidy_csv
from sweeps.rendering.rendered_table import RenderedTable, render_table
from sweeps.rendering.terminal import terminal
from sweeps.report.records import record
from sweeps.table.cells import NO_VALUE
from sweeps.table.efficiency import efficiency_cells
from sweeps.table.request import TableRequest
from sweeps.table.scoring import ScoredTable, score
from sweeps.worker.point_list import other_code_line
from sweeps.worker.trial_sources import Outcome

if TYPE_CHECKING:
    from rgbt.tracking.tracker import Tracking


def publish_table(
    request: TableRequest, outcomes: Sequence[Outcome], out: Path, tracking: Tracking
) -> int:
    """Print the table, write its files into `out`, record it in MLflow.

    Returns:
        1 where a cell failed or has no value, or the files could not be written; else 0.
    """
    runs, sizes = request.runs(outcomes), efficiency_cells(request, out)
    scored = score(request.name, request.table, runs, scale=request.scale, sizes=sizes)
    rendered = render_table(scored, request.typed_overrides())
    print_rich(terminal(rendered, plain=not sys.stdout.isatty(), width=line_width()))
    failed = _report_missing(scored, outcomes)
    try:
        files = write_files(scored, rendered, out)
    except OSError as error:
        info(f"{error.filename or out}: {error.strerror or error}; the files were not written.")
        return 1
    links = record(
        tracking,
        name=f"{request.name} {request.variant}",
        kind="table",
        files=files,
        metrics=metrics(scored, outcomes),
        tags={
            "rgbt.table": request.name,
            "rgbt.scale": request.scale,
            "rgbt.seeds": ", ".join(map(str, request.seeds)),
        },
        note=markdown(rendered),
    )
    links = [("files", f"{out}/ ({', '.join(path.name for path in files)})"), *links]
    print_rich(path_lines(links))
    return 1 if failed else 0


def write_files(scored: ScoredTable, rendered: RenderedTable, out: Path) -> list[Path]:
    """Write the table in every form, and its figure where there is something to draw."""
    out.mkdir(parents=True, exist_ok=True)
    texts = {
        "table.md": markdown(rendered),
        "table.csv": tidy_csv(scored),
        "table.tex": latex(rendered),
    }
    for name, text in texts.items():
        write_atomic(out / name, text.encode())
    figure = out / "figure.png"
    drawn = draw_table(scored, figure)
    return [*(out / name for name in texts), *([figure] if drawn else [])]


def metrics(scored: ScoredTable, outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Numbers of the table's run in MLflow: runs by state, and how well the orders agree."""
    states = [outcome.state for outcome in outcomes]
    counts = {f"runs/{state}": float(states.count(state)) for state in ("finished", "failed")}
    rhos = {f"order/{name}": order.rho for name, order in scored.orders.items()}
    return counts | {name: rho for name, rho in rhos.items() if math.isfinite(rho)}


def _report_missing(scored: ScoredTable, outcomes: Sequence[Outcome]) -> bool:
    """Lines on stderr; whether a cell failed or has no value."""
    failed = [outcome for outcome in outcomes if outcome.state == "failed"]
    others = [outcome for outcome in outcomes if outcome.state in ("running", "waiting")]
    empty = any(cell.mark == NO_VALUE for cell in scored.cells.values())
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
