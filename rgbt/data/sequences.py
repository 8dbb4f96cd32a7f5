"""Which frames of a data set follow each other, as the data set or its names say.

A sequence is a run of frames with equal steps between their numbers; a pair of consecutive frames
are two neighbours of one sequence.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from itertools import pairwise, zip_longest
from typing import Protocol, runtime_checkable

from rgbt.checks import InputError
from rgbt.dataset import DatasetWrapper, LabelledDataset, reader_of

Sequences = tuple[tuple[str, ...], ...]


@runtime_checkable
class HasVideos(Protocol):
    """A data set that knows its videos, whose frames need not be labelled."""

    def sequences(self, split: str) -> Sequences:
        """Names of all frames of a split, labelled or not, one tuple for each sequence."""
        ...


class FramesInOrder(DatasetWrapper):
    """All frames of the sequences of a split, instead of the labelled ones in the order of a list.

    Args:
        source: the data set.
        split: its only split here.

    Attributes:
        sequences: names of each sequence, in the order of their frames; two or more each.
        alone: frames without a neighbour, which are left out.

    Raises:
        InputError: no two frames of the split follow each other.
    """

    def __init__(self, source: LabelledDataset, split: str) -> None:
        super().__init__(source)
        reader = reader_of(source)
        if isinstance(reader, HasVideos):
            every = reader.sequences(split)
        else:
            every = sequences_of_names(source.names(split))
        self.sequences = tuple(each for each in every if len(each) > 1)
        self.alone = sum(len(each) == 1 for each in every)
        if not self.sequences:
            raise InputError(
                f"split '{split}' of {source.name} has no two consecutive frames among its "
                f"{self.alone} frame(s); frames=video requires names whose numbers follow each "
                "other, such as 00101D and 00102D."
            )
        self._frames = tuple(name for each in self.sequences for name in each)
        self._split = split

    @property
    def pairs(self) -> dict[str, str]:
        """Second frame -> the frame before it."""
        return {later: name for each in self.sequences for name, later in pairwise(each)}

    def names(self, split: str) -> tuple[str, ...]:
        """All frames in order; of another split as the source has them."""
        return self._frames if split == self._split else self.source.names(split)


def sequences_of_names(names: Iterable[str]) -> Sequences:
    """Runs of names that are equal but for their last number, and whose numbers are consecutive.

    Consecutive are numbers that differ by the smallest step that occurs between such names, so that
    every fifth frame of a video is a sequence too. Names without a number are alone.
    """
    groups: dict[tuple[str, str], dict[int, str]] = {}
    others: list[str] = []
    for name in dict.fromkeys(names):
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", name)
        if match is None:
            others.append(name)
        else:
            groups.setdefault((match[1], match[3]), {})[int(match[2])] = name
    runs = [run for _, frames in sorted(groups.items()) for run in consecutive(frames)]
    return (*runs, *((name,) for name in others))


def consecutive(frames: Mapping[int, str], step: int | None = None) -> Iterator[tuple[str, ...]]:
    """Frames by number, cut where these are further apart than `step`; None: the smallest step."""
    numbers = sorted(frames)
    steps = [later - number for number, later in pairwise(numbers)]
    usual = min(steps, default=1) if step is None else step
    run: list[str] = []
    for number, after in zip_longest(numbers, steps):
        run.append(frames[number])
        if after != usual:
            yield tuple(run)
            run = []
