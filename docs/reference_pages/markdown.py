"""Small pieces of Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Sequence


def table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; "" without rows. Vertical bars and new lines in cells are escaped."""
    lines = [_line(row) for row in rows]
    if not lines:
        return ""
    return "\n".join([_line(header), _line(["---"] * len(header)), *lines])


def _line(cells: Sequence[str]) -> str:
    return f"| {' | '.join(' '.join(each.split()).replace('|', chr(92) + '|') for each in cells)} |"


def code(text: str) -> str:
    """Inline code; "" stays empty."""
    return f"`{text}`" if text else ""


def block(text: str, language: str, title: str = "") -> str:
    """A fenced block."""
    shown = f' title="{title}"' if title else ""
    return f"```{language}{shown}\n{text.strip()}\n```"


def page(*parts: str) -> str:
    """Parts of a page with one empty line between them; empty parts are omitted."""
    return "\n\n".join(part.strip("\n") for part in parts if part.strip()) + "\n"
