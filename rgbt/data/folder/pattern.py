"""Parse patterns of paths such as "{split}/rgb/{name}.png", and find the files that match."""

from __future__ import annotations

import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

from rgbt.checks import InputError

NAME, SPLIT, SEQUENCE = "name", "split", "sequence"
"""Words with a meaning: the frame, its split, a group of consecutive frames."""

WordValues = Mapping[str, str]
"""Word -> its value in the path of a file."""

NO_VALUES: WordValues = MappingProxyType({})


class PathMatch(NamedTuple):
    """A file, or a folder above it, and the values of the words in its path."""

    path: Path
    values: WordValues


class Pattern:
    """Paths below a root, in which a word in braces matches any text without a slash.

    A word that occurs twice has the same value in both positions. Of two words in one piece of the
    path the first matches as much as possible: "{sequence}_{name}.png" reads a_b_c.png as a_b, c.

    Args:
        text: pieces joined by "/", relative to the root; such as "{split}/ir/{name}_ir.tif".
        key: of the configuration, for messages.

    Attributes:
        words: in braces, in order.

    Raises:
        InputError: an absolute path, "..", an unpaired brace, two words with nothing between them,
            or no word.
    """

    def __init__(self, text: str, key: str) -> None:
        self.text = text
        self.key = key
        self.pieces = tuple(text.split("/"))
        self.words = tuple(dict.fromkeys(re.findall(r"\{(\w+)\}", text)))
        if not text or not set(self.pieces).isdisjoint(("", ".", "..")):
            raise InputError(
                f"{key}: expected a path below dataset.root such as {{split}}/rgb/{{name}}.png, "
                f"without '..' and doubled slashes, got '{text}'."
            )
        if re.search(r"[{}]", re.sub(r"\{[^\W\d]\w*\}", "", text)) or "}{" in text:
            raise InputError(
                f"{key}: expected words in braces, such as {{name}}, with other text between two "
                f"of them, got '{text}'."
            )
        if not self.words:
            raise InputError(
                f"{key}: '{text}' is a single file; replace the names of frames with {{{NAME}}}, "
                f"such as rgb/{{{NAME}}}.png."
            )

    def path(self, root: Path, values: WordValues) -> Path:
        """The file of `values`, which has every word."""
        return root / _filled(self.text, values)

    def files(
        self, root: Path, values: WordValues = NO_VALUES, *, any_case: bool = False
    ) -> Iterator[PathMatch]:
        """The paths below `root` that match; words with a value match this one alone.

        Names that begin with a dot are left out, as operating systems write such files.

        Raises:
            InputError: a folder may not be listed.
        """
        return _walk(PathMatch(root, values), self.pieces, any_case=any_case)

    def why_nothing(self, root: Path) -> str:
        """The folder in which a piece matches nothing, and its content."""
        reached = [PathMatch(root, {})]
        for piece in self.pieces:
            further = [found for folder in reached for found in _matching(folder, piece)]
            if not further:
                break
            reached = further
        else:
            return "it matches"
        folder = reached[0].path
        return f"in {folder} nothing matches '{piece}'; {folder.name} holds {what_is_in(folder)}"


def what_is_in(folder: Path) -> str:
    """The first few names in `folder`, for a message."""
    names = [name for name in _listed(folder) if not name.startswith(".")]
    more = f" and {len(names) - 4} more" if len(names) > 4 else ""
    return ", ".join(names[:4]) + more if names else "nothing"


def in_order(text: str) -> list[tuple[bool, int, str]]:
    """Key to sort names by, numbers in them by their value: frame_9 comes before frame_10."""
    pieces = re.split(r"([0-9]+)", text)
    return [
        (index % 2 == 0, int(piece) if index % 2 else 0, piece)
        for index, piece in enumerate(pieces)
    ]


def _walk(start: PathMatch, pieces: tuple[str, ...], *, any_case: bool) -> Iterator[PathMatch]:
    piece, *rest = pieces
    for found in _matching(start, piece, any_case=any_case):
        if rest:
            yield from _walk(found, tuple(rest), any_case=any_case)
        else:
            yield found


def _matching(start: PathMatch, piece: str, *, any_case: bool = False) -> Iterator[PathMatch]:
    folder, values = start
    filled = _filled(piece, values)
    if "{" not in filled and not any_case:
        # A broken link matches too; the reader reports its target.
        if os.path.lexists(folder / filled):
            yield PathMatch(folder / filled, values)
        return
    expression = re.compile(_expression(filled), re.DOTALL | (re.IGNORECASE * any_case))
    for name in _listed(folder):
        match = expression.fullmatch(name)
        if match and (not name.startswith(".") or filled.startswith(".")):
            yield PathMatch(folder / name, {**values, **match.groupdict()})


def _filled(text: str, values: WordValues) -> str:
    """`text` with words replaced whose values are known."""
    return re.sub(r"\{(\w+)\}", lambda word: values.get(word[1], word[0]), text)


def _expression(piece: str) -> str:
    seen: set[str] = set()
    parts = []
    for index, part in enumerate(re.split(r"\{(\w+)\}", piece)):
        if index % 2 == 0:
            parts.append(re.escape(part))
        else:
            parts.append(f"(?P={part})" if part in seen else f"(?P<{part}>.+)")
            seen.add(part)
    return "".join(parts)


def _listed(folder: Path) -> list[str]:
    try:
        return sorted(os.listdir(folder))  # noqa: PTH208 - names alone, of thousands of files
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError:
        raise InputError(
            f"{folder} cannot be listed: permission denied; allow access (chmod a+rx)."
        ) from None
