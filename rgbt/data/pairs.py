"""Load batches of two domains together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import count

import torch

from rgbt.data.loaders import Batches
from rgbt.types import Loadable, TwoDomains


@dataclass(frozen=True)
class LoadedPair:
    """The batches of both domains; on the device they are `TwoDomains`.

    Attributes:
        source: with labels.
        target: with or without labels.
        step: optimiser step that it is for, counted from the start of the run.
    """

    source: Loadable
    target: Loadable
    step: int

    @property
    def name(self) -> tuple[str, ...]:
        """Names of all samples, those of the source first."""
        return self.source.name + self.target.name

    def to(self, device: torch.device | str) -> TwoDomains:
        """Both batches on `device` (see `Batch.to`)."""
        return TwoDomains(self.source.to(device), self.target.to(device), self.step)


class PairedBatches(Iterator[LoadedPair]):
    """A batch of the source with a batch of the target, each from its own stream.

    The two lists may differ in length. Each is shuffled again at its end, and an epoch of the run
    is one of the source. Each process has its own samples of both (`train_batches`).

    Args:
        source: of the labelled domain.
        target: of the other one.
        first: number of the first pair, counted from the start of the run.
        per_step: pairs of one optimiser step, whose number they have.
    """

    def __init__(
        self, source: Batches[Loadable], target: Batches[Loadable], *, first: int, per_step: int
    ) -> None:
        self._source = source
        self._target = target
        self._numbers = count(first)
        self._per_step = per_step

    def __next__(self) -> LoadedPair:
        """The next pair; errors as of `Batches`."""
        try:
            source, target = next(self._source), next(self._target)
        except BaseException:
            self.close()
            raise
        return LoadedPair(source, target, next(self._numbers) // self._per_step)

    @property
    def skipped(self) -> dict[str, str]:
        """Name -> error, of the samples skipped so far."""
        return self._source.skipped | self._target.skipped

    def close(self) -> None:
        """Stop the worker processes of both."""
        self._source.close()
        self._target.close()
