"""From points to run keys: the configuration of every run of a point, composed and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.component import Component
from rgbt.config.compose import compose, with_pixels
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify
from sweeps.points import Evaluation, Point


@dataclass(frozen=True)
class PlannedRun:
    """One run of a point.

    Attributes:
        key: config key, which names its folder.
        dataset: fingerprint of its data set.
        overrides: of `python -m rgbt.run`.
        steps: optimiser steps it takes.
        pixel_factor: size of its images relative to the paper's.
    """

    key: str
    dataset: str
    overrides: tuple[str, ...]
    steps: int
    pixel_factor: float = 1.0


@dataclass(frozen=True)
class Plan:
    """A point with the runs it is made of.

    Attributes:
        point: the point.
        key: names the point in a study: the key of its run, or a hash where there is more to it.
        runs: one, or one per seed.
        pixel_factor: size of its images relative to the paper's.
    """

    point: Point
    key: str
    runs: tuple[PlannedRun, ...]
    pixel_factor: float = 1.0


class Planner:
    """Plans points; every data set is looked at once.

    Args:
        base: overrides that all runs have, e.g. where runs and data lie.
    """

    def __init__(self, base: Sequence[str] = ()) -> None:
        self.base = tuple(base)
        self._fingerprints: dict[str, str] = {}

    def plan(self, point: Point) -> Plan:
        """Compose and check all runs of `point`.

        Raises:
            InputError: a configuration or a data set that does not fit, in one sentence.
        """
        runs = tuple(self._run(overrides) for overrides in point.runs())
        key = runs[0].key
        if len(runs) > 1 or point.evaluations:
            # Attributes that came later are left out where they say what older studies did.
            plain = vars(Evaluation())
            asked = [
                {
                    name: value
                    for name, value in vars(each).items()
                    if name in ("modality", "regions") or value != plain[name]
                }
                for each in point.evaluations
            ]
            parts = [[run.key for run in runs], asked]
            key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
        factor = runs[0].pixel_factor
        return Plan(replace(point, label=with_pixels(point.label, factor)), key, runs, factor)

    def spec(self, overrides: Sequence[str]) -> RunSpec:
        """The specification of one run.

        Raises:
            InputError: see `plan`; what Hydra refuses is told in the words of the command line.
        """
        with composing(overrides):
            return specify(compose(overrides), overrides)

    def _run(self, overrides: tuple[str, ...]) -> PlannedRun:
        every = (*self.base, *overrides)
        spec = self.spec(every)
        return PlannedRun(
            key=spec.key,
            dataset=self._fingerprint(spec.dataset),
            overrides=every,
            steps=spec.trainer.max_steps,
            pixel_factor=spec.scale.pixel_factor,
        )

    def _fingerprint(self, component: Component) -> str:
        text = json.dumps(component.plain, sort_keys=True)
        if text not in self._fingerprints:
            dataset: Any = component.build()
            if not any(dataset.has(split) for split in dataset.splits):
                paths = ", ".join(dict.fromkeys(dataset.splits.values()))
                raise InputError(
                    f"{dataset.root} holds none of the lists or files {paths} of the data set; "
                    "name its folder with dataset.root=..."
                )
            self._fingerprints[text] = dataset.fingerprint()
        return self._fingerprints[text]
