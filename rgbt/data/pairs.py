"""Batches of two domains side by side."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count

from rgbt.data.loaders import Batches
from rgbt.types import TwoDomains


class PairedBatches(Iterator[TwoDomains]):
    """A batch of the source with a batch of the target, each from its own stream.

    The two lists need not be of one length: each is shuffled anew when it is through, and an epoch
    of the run is one of the source.

    Args:
        source: of the labelled domain.
        target: of the other one.
        first: number of the first pair, counted from the start of the run.
        per_step: pairs of one optimiser step, whose number they have.
    """

    def __init__(self, source: Batches, target: Batches, *, first: int, per_step: int) -> None:
        self._source = source
        self._target = target
        self._numbers = count(first)
        self._per_step = per_step

    def __next__(self) -> TwoDomains:
        """The next pair; errors as of `Batches`."""
        try:
            source, target = next(self._source), next(self._target)
        except BaseException:
            self.close()
            raise
        return TwoDomains(source, target, next(self._numbers) // self._per_step)

    @property
    def skipped(self) -> dict[str, str]:
        """Name -> why it could not be read, of the samples left out so far."""
        return self._source.skipped | self._target.skipped

    def close(self) -> None:
        """Stop the worker processes of both."""
        self._source.close()
        self._target.close()
