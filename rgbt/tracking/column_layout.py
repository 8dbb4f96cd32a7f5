"""Tables cut to the width of a terminal: labels shortened, columns folded, numbers never cut."""

from __future__ import annotations

import re
from collections.abc import Sequence

ELLIPSIS = "…"
SHORTEST = 16
"""Characters that a label keeps at least; columns are folded before it gets shorter."""

SHARES = (0.5, 0.75, 0.25, 1.0, 0.0)
"""Parts of what is kept of a label that precede its cut, the preferred one first."""

LETTERS = re.compile(r"[^\W\d]{3,}")
KEYS = re.compile(r"[0-9a-f]{12}( [0-9a-f]{12})*")
"""Keys of runs, which are copied."""


def is_text(cell: str) -> bool:
    """Whether a cell is words that may be shortened: no number, interval, key or path.

    Example:
        >>> is_text("stopped after a while"), is_text("+1.20 to +3.40"), is_text("runs/454482 x")
        (True, False, False)
    """
    if not cell[:1].isalpha() or "/" in cell or KEYS.fullmatch(cell):
        return False
    return sum(LETTERS.search(word) is not None for word in cell.split()) > 1


def shortened(labels: Sequence[str], widths: Sequence[int]) -> tuple[str, ...]:
    """Labels of at most so many characters, cut inside; those that differ still do.

    Cut in the middle, or where that would make two labels equal nearer to an end. Where every cut
    does, a number in its place distinguishes them.

    Args:
        labels: of any length.
        widths: characters of each, >= `SHORTEST`.
    """
    pairs = list(zip(labels, widths, strict=True))
    for share in SHARES:
        cut = tuple(_cut(label, width, ELLIPSIS, share) for label, width in pairs)
        if len(set(cut)) == len(set(labels)):
            return cut
    numbers = {label: str(number) for number, label in enumerate(dict.fromkeys(labels), start=1)}
    return tuple(_cut(label, width, f"…{numbers[label]}…", SHARES[0]) for label, width in pairs)


def _cut(label: str, width: int, middle: str, share: float) -> str:
    if len(label) <= width:
        return label
    kept = width - len(middle)
    head = round(share * kept)
    return label[:head] + middle + label[len(label) - kept + head :]


def blocks(
    widths: Sequence[int], width: int, *, gap: int, first: int, starts: Sequence[int] = ()
) -> list[list[int]]:
    """Columns of each block of a table that is folded to a width.

    Args:
        widths: of the columns, in characters.
        width: of a line.
        gap: characters between two columns.
        first: number of columns that every block begins with: the labels.
        starts: columns that begin a group, which stays in one block where it fits; default: all.

    Returns:
        numbers of columns by block; a block has a column beside the labels, also a too wide one.
    """
    begins = sorted({first, *(starts or range(first, len(widths)))})
    ends = [*begins[1:], len(widths)]
    groups = [list(range(begin, end)) for begin, end in zip(begins, ends, strict=True)]
    labels = list(range(first))

    def taken(columns: Sequence[int]) -> int:
        return sum(widths[column] for column in columns) + gap * (len(columns) - 1)

    found: list[list[int]] = [labels.copy()]
    for group in groups:
        # A group that is wider than a block is folded itself.
        whole = [group] if taken([*labels, *group]) <= width else [[column] for column in group]
        for columns in whole:
            if len(found[-1]) > first and taken([*found[-1], *columns]) > width:
                found.append(labels.copy())
            found[-1] += columns
    return found
