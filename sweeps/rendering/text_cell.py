"""Cells and lines of a table as text, and their footnotes."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class TextCell:
    """One cell.

    Attributes:
        text: without marks.
        spread: standard deviation, or "".
        rank: 1 best of the column, 2 second best, 0 neither.
        notes: numbers of its footnotes.
    """

    text: str = ""
    spread: str = ""
    rank: int = 0
    notes: tuple[int, ...] = ()

    @property
    def whole(self) -> str:
        """With its spread."""
        return f"{self.text} ± {self.spread}" if self.spread else self.text


@dataclass(frozen=True)
class TableLine:
    """One line: "ours", "sd", "published", "difference" or "all" of a row; "order" below all."""

    kind: str
    label: TextCell
    fields: tuple[TextCell, ...]


@dataclass
class Footnotes:
    """Numbers footnotes in the order of their first use."""

    sentences: list[str] = field(default_factory=list)

    def __call__(self, *sentences: str | None) -> tuple[int, ...]:
        """Numbers of the sentences; the same sentence keeps its number."""
        numbers = []
        for sentence in filter(None, sentences):
            if sentence not in self.sentences:
                self.sentences.append(sentence)
            numbers.append(self.sentences.index(sentence) + 1)
        return tuple(numbers)
