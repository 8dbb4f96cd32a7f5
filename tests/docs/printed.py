"""What a page says that a block prints, against what it prints."""

from __future__ import annotations

import math
import re

REST = "..."
"""What stands for output that a page leaves out."""

REL_TOL, ABS_TOL = 0.01, 0.02
"""Of numbers: sums in another order differ in the last digit that is shown."""


def difference(shown: str, printed: str) -> str:
    """The first word in which two outputs differ; "": none. Line breaks do not count.

    Args:
        shown: by the page; after `REST`, anything may follow.
        printed: by the block.
    """
    expected = shown.partition(REST)[0].split()
    found = printed.split()
    for position, word in enumerate(expected):
        other = found[position] if position < len(found) else "nothing"
        if not _equal(word, other):
            return f"the page shows '{word}' as word {position + 1}, the block prints '{other}'"
    if REST not in shown and len(found) > len(expected):
        return f"the block also prints '{found[len(expected)]}'"
    return ""


def _equal(word: str, other: str) -> bool:
    if word == other:
        return True
    text, numbers = _split(word)
    other_text, other_numbers = _split(other)
    return (text, len(numbers)) == (other_text, len(other_numbers)) and all(
        math.isclose(a, b, rel_tol=REL_TOL, abs_tol=ABS_TOL)
        for a, b in zip(numbers, other_numbers, strict=True)
    )


def _split(word: str) -> tuple[str, list[float]]:
    pattern = r"[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?"
    return re.sub(pattern, "0", word), [float(each) for each in re.findall(pattern, word)]
