"""One published table as Markdown: ours with intervals beside the printed values."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field

from analysis.report.data import CellEntry
from analysis.report.views import (
    DASH,
    KINDS,
    TableView,
    fixed,
    interval_text,
    is_number,
    letters,
    seed_span,
    with_sign,
)

NOT_RUN = "not run"
NO_VALUE = "no value"
NOT_EVALUATED = "The run has no counts for this column."

MOST_ON_ONE_LINE = 2
"""Most columns with all of `KINDS` on one line; more columns have a line for each kind."""


def markdown_table(
    header: Sequence[str], rows: Iterable[Sequence[str]], texts: Collection[int] = (0,)
) -> str:
    """A table; columns at the indices `texts` are text, the others numbers."""
    rule = ["---" if index in texts else "---:" for index in range(len(header))]
    lines = (" | ".join(cell.replace("|", "\\|") for cell in row) for row in [header, rule, *rows])
    return "\n".join(f"| {line} |" for line in lines)


@dataclass
class TableText:
    """Makes the Markdown of a table.

    Attributes:
        notes: footnotes, a first.
    """

    view: TableView
    notes: list[str] = field(default_factory=list)

    def markdown(self) -> str:
        """The rows; one that was not run says so in the place of its number of seeds."""
        entry = self.view.entry
        on_one_line = len(entry.columns) <= MOST_ON_ONE_LINE
        names = list(entry.columns)
        if on_one_line:
            several = len(names) > 1
            kinds = [(name, kind) for name in names for kind in KINDS.values()]
            names = [f"{name}, {kind}" if several else kind for name, kind in kinds]
        header = ["row", "seeds", *names] if on_one_line else ["row", "", "seeds", *names]
        rows = [line for index in range(len(entry.rows)) for line in self._row(index, on_one_line)]
        return markdown_table(header, rows, (0,) if on_one_line else (0, 1))

    def _row(self, index: int, on_one_line: bool) -> list[list[str]]:
        entry, cells = self.view.entry, self.view.entry.cells[index]
        label = entry.rows[index] + self._mark(self._same_runs(index))
        was_run = any(cell.runs or is_number(cell.mean) for cell in cells)
        reason = next((cell.reason for cell in cells if cell.reason), "")
        seeds = (seed_span(cells) or DASH) if was_run else NOT_RUN + self._mark(reason)
        kinds = [kind for kind in self.view.kinds(cells) if was_run or kind == "published"]
        if on_one_line:
            texts = [
                self._text(cell, kind) if kind in kinds else DASH
                for cell in cells
                for kind in KINDS
            ]
            return [[label, seeds, *texts]]
        lines: list[list[str]] = []
        for kind in kinds or ["published"]:
            first = ["", KINDS[kind], ""] if lines else [label, KINDS[kind], seeds]
            lines.append([*first, *(self._text(cell, kind) for cell in cells)])
        return lines

    def _text(self, cell: CellEntry, kind: str) -> str:
        if kind == "ours":
            return self._ours(cell)
        if kind == "interval":
            return interval_text(cell.low, cell.high)
        if kind == "difference":
            return with_sign(cell.difference)
        return fixed(cell.published, self.view.decimals)

    def _ours(self, cell: CellEntry) -> str:
        """Mean and spread; without a value, the reason. A dash: the row has no such score."""
        mark = self._mark(cell.reason)
        if is_number(cell.mean):
            spread = f" ± {fixed(cell.sd)}" if is_number(cell.sd) else ""
            return f"{fixed(cell.mean)}{spread}{mark}"
        if cell.runs:
            return f"{NO_VALUE}{mark or self._mark(NOT_EVALUATED)}"
        return f"{NOT_RUN}{mark}" if cell.reason else DASH

    def _mark(self, note: str) -> str:
        """The letter of a footnote; the same sentence keeps its letter."""
        if not note:
            return ""
        sentence = note[0].upper() + note[1:].rstrip(".") + "."
        if sentence not in self.notes:
            self.notes.append(sentence)
        return f" ({letters(self.notes.index(sentence))})"

    def _same_runs(self, index: int) -> str:
        """A note where a row has the runs and values of a row above, as small networks are one."""
        entry, cells = self.view.entry, self.view.entry.cells
        mine = _behind(cells[index])
        for above in range(index):
            if any(runs for runs, _ in mine) and _behind(cells[above]) == mine:
                return f"At scale={entry.scale} the same runs as row {entry.rows[above]}"
        return ""


def _behind(row: Sequence[CellEntry]) -> list[tuple[tuple[str, ...], float | None]]:
    return [(cell.runs, cell.mean) for cell in row]
