"""Rows as a user writes them on the command line.

A name may be in other case, omit parentheses ("A" for "(A)") or what they contain, and omit words
after the first ("CMX" or "CMX-B2" for "CMX (MiT-B2)").
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence

from rgbt.checks import InputError, nearest


def find_label(word: str, labels: Sequence[str], what: str) -> str:
    """The label that agrees with `word` in the strictest of `WAYS`.

    Args:
        word: as typed.
        labels: of all rows.
        what: option that the word belongs to, for messages.

    Raises:
        InputError: no label, or several.
    """
    each = ([label for label in labels if agrees(word, label)] for agrees in WAYS)
    found = next(filter(None, each), [])
    if len(found) > 1:
        several = ", ".join(f"'{label}'" for label in found)
        raise InputError(f"{what}{word}: it may be any of the rows {several}; name one of them.")
    if not found:
        raise InputError(f"{what}{word}: the table has no such row; {nearest(word, labels)}.")
    return found[0]


def _plain(text: str) -> str:
    return " ".join(text.casefold().split())


def _abbreviates(name: str, label: str) -> bool:
    """Whether the words of `name` are words of `label` in their order, the first one included."""
    short, words = (re.findall(r"[^\W_]+", text.casefold()) for text in (name, label))
    rest = iter(words)
    return bool(short) and short[:1] == words[:1] and all(word in rest for word in short)


WAYS: tuple[Callable[[str, str], bool], ...] = (
    lambda name, label: name == label,
    lambda name, label: _plain(name) == _plain(label),
    lambda name, label: _plain(name) == _plain(re.sub(r"[()]", "", label)),
    lambda name, label: _plain(name) == _plain(re.sub(r"\([^)]*\)", "", label)),
    _abbreviates,
)
"""How a name agrees with a label, the strictest way first."""
