"""Counts of every input and of details, which ``rgbt evaluate`` has stored beside runs."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

from analysis.results import NamedCounts
from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.metrics.details import KINDS, DetailKind, details_of, regions_of
from rgbt.types import VIEWS

EVALUATIONS = "evaluations"


@dataclass(frozen=True)
class DetailKey:
    """What a file of counts is of.

    Attributes:
        regions: name of the partition into regions, e.g. "ring5".
        kind: of details; None: confusion matrices.
        view: input of the network; "" where the file does not say.
    """

    regions: str
    kind: DetailKind | None
    view: str = ""


def open_details(trained: Sequence[NamedCounts], split: str) -> dict[DetailKey, tuple[Counts, ...]]:
    """The stored counts of a method by what they are of, one for each training.

    Args:
        trained: runs, or files of counts.
        split: of the stored counts of runs.

    Raises:
        InputError: no stored counts, or those of another training are missing.
    """
    every = [_of_run(each, split) if each.run else _of_file(each) for each in trained]
    keys = sorted({key for found in every for key in found}, key=_order)
    for named, found in zip(trained, every, strict=True):
        missing = [key for key in keys if key not in found]
        if missing or not keys:
            views = "modality=all" if len({key.view for key in keys}) != 1 else "..."
            kinds = ",".join(dict.fromkeys(key.kind for key in missing if key.kind)) or "boundary"
            raise InputError(
                f"{named.path.parent} has no counts of {kinds} of split '{split}'; write them "
                f"with rgbt evaluate run={named.path.parent} {views} details={kinds}"
            )
    return {key: tuple(found[key] for found in every) for key in keys}


def _of_file(named: NamedCounts) -> dict[DetailKey, Counts]:
    details = details_of(named.counts.partition)
    kind = None if details is None else details.kind
    return {DetailKey(regions_of(named.counts.partition), kind): named.counts}


def _of_run(named: NamedCounts, split: str) -> dict[DetailKey, Counts]:
    """Files that are named after data set, split, view and regions, on the run's own images."""
    regions, kinds = r"[a-z]+\d+(_released_3_4)?", "|".join(KINDS)
    pattern = rf".+_{re.escape(split)}_({'|'.join(VIEWS)})_{regions}(-({kinds}))?"
    found: dict[DetailKey, Counts] = {}
    for path in sorted((named.path.parent / EVALUATIONS).glob("*.npz")):
        match = re.fullmatch(pattern, path.stem)
        if match is None:
            continue
        counts = Counts.load(path)
        details = details_of(counts.partition)
        kind = None if details is None else details.kind
        if (counts.dataset, counts.split) == (named.counts.dataset, split):
            found[DetailKey(regions_of(counts.partition), kind, match[1])] = counts
    return found


def _order(key: DetailKey) -> tuple[str, int, int]:
    kinds = (None, *KINDS)
    return key.regions, kinds.index(key.kind), ("", *VIEWS).index(key.view)
