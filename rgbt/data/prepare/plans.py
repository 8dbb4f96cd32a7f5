"""How a data set is prepared from a download: which files are needed, and their new paths.

Each data set has a plan in a module of this folder. Part of `rgbt.data.prepare`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import NamedTuple, Protocol, runtime_checkable

from rgbt.checks import InputError
from rgbt.data.prepare.copying import Item
from rgbt.data.prepare.download import SourceFile, SourceFiles
from rgbt.dataset import LabelledDataset

DEPTH = 3
"""Levels of folders in which a data set is searched, including the folder of the archive."""


class Download(NamedTuple):
    """The arguments of the command.

    Attributes:
        source: the download.
        labels: contains the labels if the download does not.
        lists: contains the lists if the download does not.
    """

    source: SourceFiles
    labels: SourceFiles | None = None
    lists: SourceFiles | None = None


class Preparation(NamedTuple):
    """How a data set is prepared.

    Attributes:
        plan: files to write, from a download.
        archives: pattern of the names of archives that are opened inside a folder.
        options: optional arguments that apply: "labels", "lists".
    """

    plan: Callable[[Download], list[Item]]
    archives: str
    options: tuple[str, ...] = ()


@runtime_checkable
class Preparable(Protocol):
    """A class of data sets that declares its preparation."""

    preparation: Preparation

    def __call__(self, root: str) -> LabelledDataset:
        """The data set in a prepared folder."""
        ...


def lists_in(source: SourceFiles, base: str, splits: Mapping[str, str]) -> dict[str, SourceFile]:
    """Name of a list -> the list, of those in the folder `base` of `source`."""
    return {
        name: source.entries[base + name]
        for name in splits.values()
        if base + name in source.entries
    }


def text_of(names: Iterable[str]) -> bytes:
    """A list, one name per line."""
    return "".join(f"{name}\n" for name in names).encode()


def add_once(found: dict[str, SourceFile], key: str, entry: SourceFile) -> None:
    """Add the file that becomes `key`; InputError if there are two."""
    if key in found:
        raise InputError(
            f"{found[key]} and {entry} would both be {key}; move one of them out of the download."
        )
    found[key] = entry


def base_of(source: SourceFiles, holds: Callable[[Callable[[str], bool]], bool], what: str) -> str:
    """Prefix of the paths in the one folder of least depth for which `holds` is true.

    `holds` is called with a function that returns whether a folder is inside; `what` is the
    expected content, for the message.
    """
    folders = source.folders()
    bases = ["" if folder == "" else f"{folder}/" for folder in folders]
    fitting = sorted(
        (base.count("/"), base)
        for base in bases
        if base.count("/") <= DEPTH and holds(lambda inner, base=base: base + inner in folders)  # type: ignore[misc]
    )
    best = [base for depth, base in fitting if depth == fitting[0][0]]
    if not best:
        raise InputError(
            f"source: {source.path} does not hold the folders {what}, nor does one of the folders "
            "in it; give the downloaded archive, or the folder into which it was unpacked."
        )
    if len(best) > 1:
        raise InputError(
            f"source: {source.path} holds {what} several times ({', '.join(best)}); give one of "
            "these folders."
        )
    return best[0]
