"""Counts of runs, each file read once."""

from __future__ import annotations

from rgbt.checks import InputError
from rgbt.metrics.counts import Counts
from rgbt.runs.result import RunResult


class LoadedCounts:
    """Counts by the key of the run and their path in its folder."""

    def __init__(self) -> None:
        self._counts: dict[tuple[str, str], Counts] = {}

    def of(self, run: RunResult, path: str) -> Counts:
        """Counts of a run; InputError where they are missing, damaged or cannot be read."""
        if (run.key, path) not in self._counts:
            try:
                self._counts[run.key, path] = run.counts(path)
            except OSError as error:
                raise InputError(f"run {run.key}: {error}") from error
        return self._counts[run.key, path]
