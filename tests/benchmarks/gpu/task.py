"""What a step gets, and how it reports: line by line, so that a step that is killed keeps them."""

from __future__ import annotations

import json
import math
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TextIO


class SkippedError(Exception):
    """A step, or a part of it, that cannot run here; the message is the reason, one sentence."""


@dataclass
class Task:
    """The work of one step process.

    Attributes:
        device: "cuda" or "cpu".
        size: "full" or "smoke".
        data: folder of MFNet, or None.
        folder: for temporary files, empty; it is removed after the step.
        seconds: until the process is killed.
        report: file of the lines.
        started: reading of the monotonic clock.
    """

    device: str
    size: str
    data: Path | None
    folder: Path
    seconds: float
    report: TextIO
    started: float = field(default_factory=time.monotonic)

    @property
    def smoke(self) -> bool:
        """Whether the smallest sizes are enough."""
        return self.size == "smoke"

    def left(self) -> float:
        """Seconds until the process is killed."""
        return self.seconds - (time.monotonic() - self.started)

    def row(self, **values: Any) -> None:
        """One line of the table of this step; the keys are its columns."""
        self.write("row", {name: _plain(value) for name, value in values.items()})

    def note(self, sentence: str) -> None:
        """A sentence below the table."""
        self.write("note", sentence)

    def headline(self, text: str) -> None:
        """The main figure, printed when the step ends; the last one counts."""
        self.write("headline", text)

    def as_time_allows(self, names: list[str], first: float) -> Iterator[str]:
        """The names, as long as the longest part so far fits the time that is left.

        Args:
            names: of the parts, the most important ones first.
            first: seconds that the first part may take.
        """
        longest = first
        for index, name in enumerate(names):
            if self.left() < longest:
                self.note(f"not measured for lack of time: {', '.join(names[index:])}.")
                return
            began = time.monotonic()
            yield name
            longest = max(longest if index else 0.0, time.monotonic() - began)

    def write(self, kind: str, value: Any) -> None:
        """Append one line: "row", "note", "headline", "skipped" or "failed"."""
        self.report.write(json.dumps({kind: value}) + "\n")
        self.report.flush()


def _plain(value: Any) -> Any:
    """A value for JSON: four significant digits, no NaN."""
    if not isinstance(value, float):
        return value
    return float(f"{value:.4g}") if math.isfinite(value) else str(value)


def sentence_of(error: BaseException) -> str:
    """Type, first line of the message, and the last line of our code that was running."""
    said = (str(error).strip() or "no message").splitlines()[0]
    own = [
        f"{Path(frame.filename).name}:{frame.lineno}"
        for frame in traceback.extract_tb(error.__traceback__)
        if "site-packages" not in frame.filename
    ]
    return f"{type(error).__name__}: {said} ({own[-1] if own else 'no line'})"
