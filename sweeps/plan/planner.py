"""From points to run keys: every run of a point is composed and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from rgbt.checks import InputError
from rgbt.config.compose import compose, with_pixels
from rgbt.config.overrides import composing
from rgbt.runs.needs import Lacking, lacking
from rgbt.runs.result import RunResult
from rgbt.runs.run_spec import RunSpec, settings_digest
from rgbt.runs.specify import requested_run, specify
from sweeps.point import Outcome, Point, State


@dataclass(frozen=True)
class PlannedPoint:
    """Holds a point with its runs: one, or one per seed.

    `key` identifies it in a study: the key of its run, or a hash of several or of further
    evaluations. `fingerprints`: key of a run -> fingerprint of its data set.
    """

    point: Point
    key: str
    runs: tuple[RunSpec, ...]
    fingerprints: Mapping[str, str]

    def outcome(
        self, state: State, reason: str = "", results: tuple[RunResult, ...] = ()
    ) -> Outcome:
        """Return an outcome of this point."""
        return Outcome(self.point, state, reason, results, tuple(run.key for run in self.runs))


def specify_run(overrides: Sequence[str], *, checked: bool = True) -> RunSpec:
    """Return the specification of one run; InputError in the words of the command line.

    Without `checked`, no class that the settings name is imported, so that torch is not either.
    """
    with composing(overrides):
        config = compose(overrides)
        return specify(config, overrides) if checked else requested_run(config, overrides)


class Planner:
    """Plans points; equal runs are specified once, and each data set is read once."""

    def __init__(self, base: Sequence[str] = ()) -> None:
        self.base = tuple(base)  # overrides that all runs have, e.g. the folder of runs
        self._fingerprints: dict[str, str] = {}
        self._specified: dict[tuple[str, ...], RunSpec] = {}
        self._checked: set[tuple[str, ...]] = set()

    def plan(self, point: Point) -> PlannedPoint:
        """Compose and check all runs of `point`; InputError where something does not fit."""
        runs = tuple(self.specify((*self.base, *overrides)) for overrides in point.runs())
        key = runs[0].key
        if len(runs) > 1 or point.evaluations:
            parts = [[run.key for run in runs], point.evaluations]
            key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
        label = with_pixels(point.label, runs[0].scale.pixel_factor)
        fingerprints = {run.key: self.fingerprint(run) for run in runs}
        return PlannedPoint(replace(point, label=label), key, runs, fingerprints)

    def fingerprint(self, run: RunSpec) -> str:
        """Return the fingerprint of the data set of a run; InputError for one without an image."""
        name = json.dumps(run.dataset.plain, sort_keys=True)
        if name not in self._fingerprints:
            dataset: Any = run.dataset.build()
            if not any(dataset.has(split) for split in dataset.splits):
                paths = ", ".join(dict.fromkeys(dataset.splits.values()))
                raise InputError(f"dataset.root={dataset.root}: it has none of the files {paths}.")
            self._fingerprints[name] = str(dataset.fingerprint())
        return self._fingerprints[name]

    def composed(self, point: Point) -> RunSpec | None:
        """Return the first run of a point, unchecked; None where it cannot be composed."""
        try:
            return self.specify((*self.base, *point.runs()[0]), checked=False)
        except InputError:
            return None

    def lacking(self, point: Point) -> Lacking:
        """Return what the runs of a point lack; {} where they cannot be composed."""
        run = self.composed(point)
        return {} if run is None else lacking(run)

    def row_digest(self, overrides: tuple[str, ...]) -> str:
        """Return the digest of the settings of `overrides`; "" where they do not fit alone."""
        try:
            return settings_digest(self.specify((*self.base, *overrides), checked=False).plain)
        except InputError:
            return ""

    def specify(self, overrides: tuple[str, ...], *, checked: bool = True) -> RunSpec:
        """Return the specification of one run (`specify_run`).

        Runs that differ in their last override alone, a seed, are composed once.
        """
        *others, last = overrides
        seed = last.removeprefix("seed=")
        is_seed = seed != last and seed.isdecimal()
        same = tuple(others) if is_seed else overrides
        if same not in self._specified:
            self._specified[same] = specify_run(overrides, checked=False)
        run = self._specified[same]
        if checked and same not in self._checked:
            run.check()
            self._checked.add(same)
        return run.with_seed(int(seed)) if is_seed else run
