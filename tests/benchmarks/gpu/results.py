"""The results of the steps, and their two files."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

DONE, FAILED, STOPPED, SKIPPED = "done", "failed", "stopped", "skipped"


@dataclass
class StepResult:
    """What became of a step.

    Attributes:
        name: of the step.
        title: what it measures.
        status: "done", "failed", "stopped" at its limit, or "skipped".
        reason: one sentence, where it was not done.
        seconds: that it took.
        limit: that it had.
        headline: its main figure.
        rows: what it measured, also where it was stopped.
        notes: sentences about it.
        log: name of the file with its output.
    """

    name: str
    title: str
    status: str = DONE
    reason: str = ""
    seconds: float = 0.0
    limit: float = 0.0
    headline: str = ""
    rows: list[dict[str, Any]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    log: str = ""

    def read(self, report: Path) -> None:
        """Take the lines that a step process has written; a last line that was cut is left out."""
        if not report.is_file():
            return
        for line in report.read_text().splitlines():
            try:
                ((kind, value),) = json.loads(line).items()
            except (ValueError, AttributeError):
                continue
            if kind == "row":
                self.rows.append(value)
            elif kind == "note":
                self.notes.append(value)
            elif kind == "headline":
                self.headline = value
            else:
                self.status, self.reason = kind, value

    def line(self) -> str:
        """The main figure, or why there is none."""
        if self.status == DONE:
            return self.headline or f"{len(self.rows)} rows"
        before = f" Before: {self.headline or f'{len(self.rows)} rows'}." if self.rows else ""
        return f"{self.status}: {self.reason}{before}"


def write(folder: Path, command: str, started: str, results: Sequence[StepResult]) -> None:
    """Write ``results.json`` and ``results.md``; each is replaced at once."""
    content = {"command": command, "started": started, "steps": [asdict(each) for each in results]}
    _replace(folder / "results.json", json.dumps(content, indent=1) + "\n")
    _replace(folder / "results.md", markdown(command, started, results))


def markdown(command: str, started: str, results: Sequence[StepResult]) -> str:
    """The page of the results: an overview, then the table of each step."""
    overview = [
        {"step": each.name, "result": each.line(), "seconds": round(each.seconds, 1)}
        for each in results
    ]
    parts = ["# GPU measurements", f"`{command}`, {started}", table(overview)]
    for each in results:
        parts.append(f"## {each.title}")
        if each.status != DONE:
            parts.append(f"{each.status}: {each.reason}")
        if each.rows:
            parts.append(table(each.rows))
        parts += each.notes
        if each.log:
            parts.append(f"Log: `{each.log}`")
    return "\n\n".join(parts) + "\n"


def table(rows: Sequence[dict[str, Any]]) -> str:
    """A Markdown table; the columns are all keys in the order in which they first occur."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    lines = [columns, ["---"] * len(columns)]
    lines += [[_cell(row.get(name)) for name in columns] for row in rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines)


def _cell(value: Any) -> str:
    return "" if value is None else str(value).replace("|", "\\|").replace("\n", " ")


def _replace(path: Path, text: str) -> None:
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    temporary.replace(path)
