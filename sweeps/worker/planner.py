"""From points to run keys: every run of a point is composed and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from rgbt.checks import InputError
from rgbt.config.command import composing
from rgbt.config.compose import compose, with_pixels
from rgbt.spec.corruption_names import row_name
from rgbt.spec.run_spec import RunSpec
from rgbt.spec.specify import specify
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Point


@dataclass(frozen=True)
class PlannedRun:
    """One run of a point.

    Attributes:
        key: config key, which names its folder.
        dataset: fingerprint of its data set.
        overrides: of `python -m rgbt.run`.
        steps: optimizer steps.
        pixel_factor: size of its images relative to the paper's.
        consistency_splits: splits on which it measures its temporal consistency.
    """

    key: str
    dataset: str
    overrides: tuple[str, ...]
    steps: int
    pixel_factor: float = 1.0
    consistency_splits: tuple[str, ...] = ()


@dataclass(frozen=True)
class PlannedPoint:
    """A point with its runs: one, or one per seed.

    Attributes:
        key: identifies the point in a study: the key of its run; of several runs or with further
            evaluations, a hash.
    """

    point: Point
    key: str
    runs: tuple[PlannedRun, ...]


def specify_run(overrides: Sequence[str]) -> RunSpec:
    """The specification of one run.

    Raises:
        InputError: Hydra or a component refuses an override, in the words of the command line.
    """
    with composing(overrides):
        return specify(compose(overrides), overrides)


class Planner:
    """Plans points; equal runs are specified once, and each data set is read once.

    Args:
        base: overrides that all runs have, e.g. the folders of runs and data.
    """

    def __init__(self, base: Sequence[str] = ()) -> None:
        self.base = tuple(base)
        self._fingerprints: dict[str, str] = {}
        self._planned: dict[tuple[str, ...], PlannedRun] = {}
        self._specified: dict[tuple[str, ...], RunSpec] = {}

    def plan(self, point: Point) -> PlannedPoint:
        """Compose and check all runs of `point`.

        Raises:
            InputError: a configuration or a data set that does not fit, in one sentence.
        """
        runs = tuple(self.plan_run((*self.base, *overrides)) for overrides in point.runs())
        key = runs[0].key
        if len(runs) > 1 or point.evaluations:
            evaluations = [_identity(evaluation) for evaluation in point.evaluations]
            parts = [[run.key for run in runs], evaluations]
            key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
        label = with_pixels(point.label, runs[0].pixel_factor)
        return PlannedPoint(replace(point, label=label), key, runs)

    def plan_run(self, overrides: tuple[str, ...]) -> PlannedRun:
        """Specify one run and read its data set; raises as `plan`."""
        if overrides not in self._planned:
            self._planned[overrides] = self._plan_run(overrides)
        return self._planned[overrides]

    def _plan_run(self, overrides: tuple[str, ...]) -> PlannedRun:
        spec = self.specify(overrides)
        name = json.dumps(spec.dataset.plain, sort_keys=True)
        if name not in self._fingerprints:
            dataset: Any = spec.dataset.build()
            if not any(dataset.has(split) for split in dataset.splits):
                paths = ", ".join(dict.fromkeys(dataset.splits.values()))
                raise InputError(
                    f"{dataset.root} contains none of the lists or files {paths} of the data set; "
                    "set dataset.root=... to its folder"
                )
            self._fingerprints[name] = str(dataset.fingerprint())
        views = spec.consistency.values
        return PlannedRun(
            key=spec.key,
            dataset=self._fingerprints[name],
            overrides=overrides,
            steps=spec.trainer.max_steps,
            pixel_factor=spec.scale.pixel_factor,
            consistency_splits=tuple(views["splits"]) if views["sets"] else (),
        )

    def specify(self, overrides: tuple[str, ...]) -> RunSpec:
        """The specification of one run; seeds of the same run are composed once.

        Raises:
            InputError: see `specify_run`.
        """
        *others, last = overrides
        seed = last.removeprefix("seed=")
        if seed == last or not seed.isdecimal():
            return specify_run(overrides)
        same = tuple(others)
        if same not in self._specified:
            self._specified[same] = specify_run(overrides)
        return self._specified[same].with_seed(int(seed))


def _identity(evaluation: ExtraEvaluation) -> dict[str, object]:
    """The attributes of an evaluation that keys of points hold.

    Attributes that came after the first studies are left out at their defaults, and a corruption
    has the name that it had then, so that the keys of older studies stay the same.
    """
    defaults = vars(ExtraEvaluation())
    identity: dict[str, object] = {}
    for name, value in vars(evaluation).items():
        if name == "corruption" and value is not None:
            identity["degradation"] = row_name(value)
        elif name in ("modality", "regions") or value != defaults[name]:
            identity[name] = value
    return identity
