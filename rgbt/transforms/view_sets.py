"""Fixed sets of angles for evaluation: one virtual view for every image of a split."""

from __future__ import annotations

import hashlib
import json
import math
from functools import cached_property
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import InputError, nearest, one_line
from rgbt.files.plain_files import read_bytes
from rgbt.ranges import Names
from rgbt.requirements import Record, record_of
from rgbt.transforms.virtual_view import VirtualView

HEADER = "yaw,pitch,roll"
PUBLISHED = Path(__file__).with_name("angles")
"""The three sets of the Temporal release: 393 triples each, one per image of MFNet's test list."""

PUBLISHED_VIEWS = "e93922"
"""Digest of ``conf/consistency/views.yaml``, on which published TC and CA were measured."""

Split = Literal["val", "test"]


class ViewSets:
    """The virtual views and splits on which consistency (TC and CA) is measured.

    Source: Temporal, Table I: the mean over the same three sets of angles; the sets are those of
    its release. The k-th triple belongs to the k-th image of the split's list; a split with more
    images than triples begins again with the first triple.

    Args:
        view: how a triple becomes a view; its ranges of angles are not drawn from.
        sets: names of published sets ("released_1" .. "released_3"), or CSV files with the columns
            yaw,pitch,roll in degrees. None: a run measures no consistency.
        splits: what a run measures at its end, with its best checkpoint.

    Raises:
        InputError: no such set, a line that is no triple, or a triple that leaves no rectangle.
    """

    def __init__(self, *, view: VirtualView, sets: Names, splits: tuple[Split, ...]) -> None:
        self.view = view
        self.sets = sets
        self.splits = splits
        if sets and not splits:
            raise InputError(
                "consistency.splits is empty, so consistency.sets would not be measured. Name val "
                "or test, or choose consistency=none."
            )
        self._triples = [read_angles(name) for name in sets]
        for name, triples in zip(sets, self._triples, strict=True):
            try:
                view.check(triples)
            except InputError as error:
                raise InputError(f"consistency.sets: {name}: {error}") from error

    @property
    def record(self) -> Record:
        """What its views require of the data set."""
        requires = record_of(self.view).requires if self.sets else ()
        return Record(requires=tuple(each.inside("consistency") for each in requires))

    @cached_property
    def mark(self) -> str:
        """Empty for the published views; six hexadecimal digits of any others, for names of files.

        Depends on the triples and on how they become views, not on names or places of files.
        """
        triples = [each.tolist() for each in self._triples]
        text = json.dumps([self.view.settings(), triples], sort_keys=True)
        digest = hashlib.sha256(text.encode()).hexdigest()[:6]
        return "" if digest == PUBLISHED_VIEWS else digest

    def angles(self, number: int, indices: list[int]) -> Tensor:
        """(B, 3) float64 degrees: the triples of set `number` (0-based) for images of a split.

        Args:
            number: of the set.
            indices: places of the images in the split's list.
        """
        triples = self._triples[number]
        return triples[torch.tensor(indices) % len(triples)]


def read_angles(name: str) -> Tensor:
    """(N, 3) float64: the triples of a published set, or of a file.

    Raises:
        InputError: neither a published set nor a file, or a line that is no triple of numbers.
    """
    published = {path.stem: path for path in PUBLISHED.glob("*.csv")}
    path = published.get(name, Path(name).expanduser())
    if not path.is_file():
        raise InputError(
            f"consistency.sets: '{name}' is neither a published set of angles nor a file; "
            f"{nearest(name, published)}, or give a CSV file with the columns {HEADER}."
        )
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(
            f"consistency.sets: {path} is not UTF-8 text; save it as a CSV file with the columns "
            f"{HEADER}."
        ) from error
    header, *lines = [line.replace(" ", "") for line in text.splitlines() if line.strip()] or [""]
    if header != HEADER or not lines:
        raise InputError(
            f"consistency.sets: {path} must begin with the line '{HEADER}', then one triple of "
            f"degrees per line, got '{one_line(header)}' and {len(lines)} lines."
        )
    triples = []
    for line in lines:
        try:
            triple = [float(word) for word in line.split(",")]
        except ValueError:
            triple = []
        if len(triple) != 3 or not all(map(math.isfinite, triple)):
            raise InputError(
                f"consistency.sets: {path}: expected yaw,pitch,roll in degrees, got "
                f"'{one_line(line)}'."
            )
        triples.append(triple)
    return torch.tensor(triples, dtype=torch.float64)
