"""A computed table as files: Markdown, LaTeX (booktabs) and tidy CSV."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rgbt.tables import csv_text
from sweeps.rendering.rendered_table import RenderedTable, TextCell
from sweeps.table.cells import ScoredTable, TableCell, published

LEGEND = "Bold: shown to be the best of our rows, underlined: the second best."

CSV_HEADER = (
    *("table", "row", "column", "mean", "sd", "n", "published", "difference", "reason", "runs"),
)
NOT_IN_PAPERS = ("difference",)
"""Kinds of lines that a table in a paper does not have."""

LATEX_SPECIAL = {
    "\\": r"\textbackslash{}",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "±": r"$\pm$",
    **{letter: f"\\{letter}" for letter in "&%$#_{}"},
}


def markdown(rendered: RenderedTable) -> str:
    """The table in Markdown, with title, footnotes and remarks."""

    def shown(text: TextCell) -> str:
        escaped = text.whole.replace("|", "\\|")
        mark = ("", "**", "<u>")[text.rank]
        numbers = ", ".join(map(str, text.notes))
        notes = f"<sup>{numbers}</sup>" if numbers else ""
        return f"{mark}{escaped}{mark.replace('<', '</')}{notes}"

    rule = ["---", *("---:" if text.text else "---" for text in rendered.header)]
    rows = [[shown(text) for text in (TextCell(), *rendered.header)], rule]
    rows += [[shown(text) for text in (line.label, *line.fields)] for line in rendered.lines]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    notes = [f"{index}. {note}" for index, note in enumerate(rendered.notes, start=1)]
    remarks = [f"- {remark}" for remark in rendered.remarks_with(LEGEND)]
    blocks = [[f"**{shown(rendered.title)}**"], lines, notes, remarks]
    return "\n\n".join("\n".join(block) for block in blocks if block) + "\n"


def latex(rendered: RenderedTable) -> str:
    """A LaTeX table that needs the package booktabs: ours and published, without differences."""

    def shown(text: TextCell) -> str:
        command = ("", r"\textbf", r"\underline")[text.rank]
        escaped = _escaped(text.whole)
        notes = f"$^{{{','.join(map(str, text.notes))}}}$" if text.notes else ""
        return f"{command}{{{escaped}}}{notes}" if command else f"{escaped}{notes}"

    def row(texts: Iterable[TextCell]) -> str:
        return " & ".join(map(shown, texts)) + r" \\"

    sides = "".join("r" if text.text else "l" for text in rendered.header)
    lines = [line for line in rendered.lines if line.kind not in NOT_IN_PAPERS]
    below = [f"$^{{{i}}}$ {_escaped(note)}" for i, note in enumerate(rendered.notes, start=1)]
    below += [_escaped(remark) for remark in rendered.remarks_with(LEGEND)]
    return "\n".join(
        [
            "% needs \\usepackage{booktabs}",
            r"\begin{table}",
            r"\centering",
            rf"\caption{{{shown(rendered.title)}}}",
            rf"\begin{{tabular}}{{l{sides}}}",
            r"\toprule",
            row((TextCell(), *rendered.header)),
            r"\midrule",
            *(row((line.label, *line.fields)) for line in lines),
            r"\bottomrule",
            r"\end{tabular}",
            *(rf"\par\footnotesize {sentence}" for sentence in below),
            r"\end{table}",
            "",
        ]
    )


def tidy_csv(scored: ScoredTable) -> str:
    """One line per row and column, with all digits that mean something.

    Columns: `CSV_HEADER`; empty where there is no value. Values are in the unit of the table;
    `n` is the number of seeds, `runs` are keys of runs.
    """
    rows: list[tuple[object, ...]] = [CSV_HEADER]
    nothing = TableCell(math.nan, math.nan, 0)
    for row in scored.table.rows:
        for column in scored.table.columns:
            cell = scored.cells.get((row.label, column.name), nothing)
            printed = published(row, column)
            ours = (_plain(cell.mean), _plain(cell.sd), cell.seeds)
            theirs = ("" if printed is None else printed, _plain(scored.difference(row, column)))
            cell_id = (scored.name, row.label, column.name)
            rows.append((*cell_id, *ours, *theirs, cell.reason, " ".join(cell.keys)))
    return csv_text(rows)


def _plain(value: float) -> str:
    return "" if math.isnan(value) else repr(round(value, 6))


def _escaped(text: str) -> str:
    return "".join(LATEX_SPECIAL.get(letter, letter) for letter in text)
