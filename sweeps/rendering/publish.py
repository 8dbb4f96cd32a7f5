"""Prints a computed table, writes its files and records it in MLflow."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rgbt.files.atomic import write_atomic
from rgbt.tables import TextTable
from rgbt.terminal import info, path_lines, print_rich, rich_table
from sweeps.point import Outcome
from sweeps.rendering.claims import claims_csv, claims_grid, claims_markdown, counted
from sweeps.rendering.effects import effects_csv, effects_grids
from sweeps.rendering.effects_figure import draw_effects
from sweeps.rendering.figure import draw_table
from sweeps.rendering.file_formats import latex, markdown, tidy_csv
from sweeps.rendering.rendered_table import RenderedTable, render_table
from sweeps.rendering.terminal import terminal
from sweeps.report.records import record
from sweeps.table.cells import NO_VALUE, ScoredTable, score, size_marks
from sweeps.table.efficiency import efficiency_cells
from sweeps.table.request import TableRequest
from sweeps.table.table import Table
from sweeps.verdicts.effects import DesignEffects, DesignJudge
from sweeps.verdicts.forms import forms_grid
from sweeps.verdicts.judge import CellRunId, JudgedClaim, TableJudge
from sweeps.worker.point_list import other_code_line

if TYPE_CHECKING:
    from rgbt.tracking.tracker import Tracking


@dataclass(frozen=True, kw_only=True)
class Findings:
    """What the finished runs of a table say beside its values.

    Attributes:
        claims: judged.
        forms: differences of the forms as text; None where one form was run.
        effects: of the factors of its design; None where it has none.
    """

    claims: Sequence[JudgedClaim] = ()
    forms: TextTable | None = None
    effects: DesignEffects | None = None


def publish_table(
    judge: TableJudge,
    request: TableRequest,
    outcomes: Sequence[Outcome],
    external: Mapping[CellRunId, Outcome],
    out: Path,
    tracking: Tracking,
) -> int:
    """Print the table and its claims, write its files into `out`, record it in MLflow.

    Args:
        judge: of the table.
        request: the table.
        outcomes: of its points.
        external: runs of rows that are not trained.
        out: folder of the files.
        tracking: the tracker.

    Returns:
        1 where a cell failed or has no value, or the files could not be written; else 0.
    """
    runs: dict[CellRunId, Outcome] = {**request.runs(outcomes), **external}
    sizes = efficiency_cells(request)
    scored = replace(
        score(request.name, request.table, runs, scale=request.scale, sizes=sizes),
        form=request.form,
        marks=judge.marks(runs) | size_marks(request.table, sizes),
    )
    has_design = request.table.design is not None
    findings = Findings(
        claims=judge.claims(runs),
        forms=forms_grid(judge, runs),
        effects=DesignJudge(request.table).effects(runs) if has_design else None,
    )
    rendered = render_table(scored, request.typed_overrides())
    rendered = replace(rendered, remarks=(*rendered.remarks, *_not_trained(request)))
    print_rich(terminal(rendered, plain=not sys.stdout.isatty()))
    if findings.forms is not None:
        print_rich(rich_table(findings.forms))
    for grid in _effects_of(findings, request.table):
        print_rich(rich_table(grid))
    if findings.claims:
        print_rich(rich_table(claims_grid(findings.claims, counted(findings.claims))))
    failed = _report_missing(scored, outcomes)
    try:
        files = write_files(scored, rendered, findings, out)
    except OSError as error:
        info(f"{error.filename or out}: {error.strerror or error}; the files were not written.")
        return 1
    links = record(
        tracking,
        name=f"{request.name} {request.variant}",
        kind="table",
        files=files,
        metrics=metrics(findings.claims, outcomes),
        tags={
            "rgbt.table": request.name,
            "rgbt.scale": request.scale,
            "rgbt.form": request.form,
            "rgbt.seeds": ", ".join(map(str, scored.seeds)),
        },
        note=_whole_markdown(request.table, rendered, findings),
    )
    links = [("files", f"{out}/ ({', '.join(path.name for path in files)})"), *links]
    print_rich(path_lines(links))
    return 1 if failed else 0


def _not_trained(request: TableRequest) -> list[str]:
    """A sentence on rows that are evaluated and not trained."""
    words = [word for word in request.typed if word.startswith(("weights.", "predictions."))]
    if not words:
        return []
    return [
        f"Not trained here, so that their spread over trainings is not known: {'; '.join(words)}."
    ]


def write_files(
    scored: ScoredTable, rendered: RenderedTable, findings: Findings, out: Path
) -> list[Path]:
    """Write the table in every format, its claims, and its figure if there is one to draw."""
    out.mkdir(parents=True, exist_ok=True)
    texts = {
        "table.md": _whole_markdown(scored.table, rendered, findings),
        "table.csv": tidy_csv(scored),
        "table.tex": latex(rendered),
    }
    if findings.claims:
        texts["claims.csv"] = claims_csv(findings.claims)
    if findings.effects is not None:
        texts["effects.csv"] = effects_csv(findings.effects.lines)
    for name, text in texts.items():
        write_atomic(out / name, text.encode())
    figure = out / "figure.png"
    if findings.effects is None:
        drawn = draw_table(scored, figure)
    else:
        drawn = draw_effects(findings.effects, scored.name, figure)
    return [*(out / name for name in texts), *([figure] if drawn else [])]


def _effects_of(findings: Findings, table: Table) -> list[TextTable]:
    if findings.effects is None or table.design is None:
        return []
    return effects_grids(findings.effects, table.design)


def _whole_markdown(table: Table, rendered: RenderedTable, findings: Findings) -> str:
    parts = [markdown(rendered)]
    parts += [] if findings.forms is None else [findings.forms.to_markdown()]
    parts += [grid.to_markdown() for grid in _effects_of(findings, table)]
    parts += [claims_markdown(findings.claims)] if findings.claims else []
    return "\n".join(parts)


def metrics(claims: Sequence[JudgedClaim], outcomes: Sequence[Outcome]) -> dict[str, float]:
    """Numbers of the table's run in MLflow: runs by state, claims by verdict."""
    states = [outcome.state for outcome in outcomes]
    words = [claim.word.replace(" ", "_") for claim in claims]
    counts = {f"runs/{state}": float(states.count(state)) for state in ("finished", "failed")}
    return counts | {f"claims/{word}": float(words.count(word)) for word in sorted(set(words))}


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
