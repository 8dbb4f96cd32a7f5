"""From points to run keys: every run of a point is composed and checked."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, replace

from rgbt.config.compose import with_pixels
from sweeps.evaluation import ExtraEvaluation
from sweeps.point import Point
from sweeps.run_specs import PlannedRun, plan_run


@dataclass(frozen=True)
class PlannedPoint:
    """A point with its runs.

    Attributes:
        point: the point.
        key: identifies the point in a study: the key of its run; of several runs or with further
            evaluations, a hash.
        runs: one, or one per seed.
    """

    point: Point
    key: str
    runs: tuple[PlannedRun, ...]

    @property
    def pixel_factor(self) -> float:
        """Size of its images relative to the paper's."""
        return self.runs[0].pixel_factor


class Planner:
    """Plans points; the fingerprint of every data set is computed once.

    Args:
        base: overrides that all runs have, e.g. the folders of runs and data.
    """

    def __init__(self, base: Sequence[str] = ()) -> None:
        self.base = tuple(base)
        self._fingerprints: dict[str, str] = {}

    def plan(self, point: Point) -> PlannedPoint:
        """Compose and check all runs of `point`.

        Raises:
            InputError: a configuration or a data set that does not fit, in one sentence.
        """
        runs = tuple(
            plan_run((*self.base, *overrides), self._fingerprints) for overrides in point.runs()
        )
        key = runs[0].key
        if len(runs) > 1 or point.evaluations:
            evaluations = [_identity(evaluation) for evaluation in point.evaluations]
            parts = [[run.key for run in runs], evaluations]
            key = hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:12]
        label = with_pixels(point.label, runs[0].pixel_factor)
        return PlannedPoint(replace(point, label=label), key, runs)


def _identity(evaluation: ExtraEvaluation) -> dict[str, object]:
    """The attributes of an evaluation that keys of points hold.

    Attributes that came after the first studies are left out at their defaults, so that the keys
    of older studies stay the same.
    """
    defaults = vars(ExtraEvaluation())
    return {
        name: value
        for name, value in vars(evaluation).items()
        if name in ("modality", "regions") or value != defaults[name]
    }
