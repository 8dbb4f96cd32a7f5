"""Prints a judged table and what is missing; writes its files."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Group

from rgbt.files.atomic import write_atomic
from rgbt.tables import TextTable
from rgbt.terminal import info, path_lines, print_rich, rich_table
from sweeps.judge.effects import effects_of
from sweeps.judge.judged_table import JudgedTable
from sweeps.point import Outcome
from sweeps.run.point_list import other_code_line
from sweeps.score.cells import NO_VALUE
from sweeps.show.claims import claim_grids, claims_frame, claims_markdown, counted, frame_csv
from sweeps.show.effects import effects_figure, effects_grids
from sweeps.show.figure import figure_of
from sweeps.show.table import Style, latex, render_table, tidy_csv

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure


def publish_table(judged: JudgedTable, outcomes: Sequence[Outcome], out: Path) -> int:
    """Print the table and its claims, and write its files into `out`.

    Returns:
        1 where a cell failed or has no value, or the files could not be written; else 0.
    """
    design = judged.request.table.design
    shown = grid_of(judged, "terminal")
    claims = claims_frame(judged.claims)
    effects, lacking = effects_of(judged)
    of_effects = [] if design is None else effects_grids(effects, lacking, design)
    grids = [shown, *of_effects, *claim_grids(claims, noted=True)]
    print_rich(Group(*(rich_table(grid) for grid in grids)))
    failed = _report_missing(judged, outcomes)
    if len(claims):
        print_rich(counted(claims))
    parts = [grid.to_markdown() for grid in (grid_of(judged, "markdown"), *of_effects)]
    if len(claims):
        parts.append(claims_markdown(claims))
    texts = {
        "table.md": "\n".join(parts),
        "table.csv": tidy_csv(judged.scored),
        "table.tex": latex(shown),
    }
    if len(claims):
        texts["claims.csv"] = frame_csv(claims)
    if design is not None:
        texts["effects.csv"] = frame_csv(effects)
    files = list(texts)
    try:
        out.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_atomic(out / name, text.encode())
        drawn = drawn_of(judged, effects)
        if drawn is not None:
            from analysis.figures.plots import save

            save(drawn, out / "figure.png")
            files.append("figure.png")
    except OSError as error:
        info(f"{error.filename or out}: {error.strerror or error}; the files were not written.")
        return 1
    print_rich(path_lines([("files", f"{out}/ ({', '.join(files)})")]))
    return 1 if failed else 0


def grid_of(judged: JudgedTable, style: Style) -> TextTable:
    """Return the grid of a table with all that was typed for it."""
    request = judged.request
    words = [word for word in request.typed if word.startswith(("weights.", "predictions."))]
    remarks = []
    if words:
        spread = "so that their spread over trainings is not known"
        remarks.append(f"Not trained here, {spread}: {'; '.join(words)}.")
    return render_table(judged.scored, style, request.typed_overrides(), remarks)


def drawn_of(judged: JudgedTable, effects: pd.DataFrame) -> Figure | None:
    """Draw a table, of a design its effects; None: there is nothing to draw."""
    if judged.request.table.design is not None:
        return effects_figure(effects, judged.request.name)
    return figure_of(judged.scored)


def _report_missing(judged: JudgedTable, outcomes: Sequence[Outcome]) -> bool:
    """Lines on stderr; whether a cell failed or has no value."""
    states = Counter(outcome.state for outcome in outcomes)
    failed = states["failed"]
    if failed:
        info(
            f"{failed} of {len(outcomes)} runs failed, see the footnotes; rerun with retry=failed."
        )
    if missing := states["missing"]:
        info(f"{missing} of {len(outcomes)} runs are missing something, see the footnotes.")
    others = states["running"] + states["waiting"]
    if others:
        info(f"{others} of {len(outcomes)} runs are not finished; rerun the command later.")
    other_code = other_code_line(outcomes)
    if other_code:
        info(other_code)
    return failed > 0 or any(cell.mark == NO_VALUE for cell in judged.scored.cells.values())
