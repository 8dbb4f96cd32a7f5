"""What a driver executes next: a trial that it has claimed."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

from rgbt.tracking.provenance import without_passwords
from sweeps import attributes as names
from sweeps.worker.planner import PlannedPoint
from sweeps.worker.running_trial import PruningCallback


@dataclass(frozen=True)
class ClaimedTrial:
    """A trial that this driver executes.

    Attributes:
        plan: its point.
        number: of the trial.
        report: see `sweeps.worker.running_trial.RunningTrial`.
    """

    plan: PlannedPoint
    number: int
    report: PruningCallback | None = None


class TrialSource(Protocol):
    """Gives a driver its trials."""

    requeues: bool
    """Whether a trial that is given up is enqueued in the study."""

    rejected: int
    """Points whose configuration is wrong."""

    def next(self) -> ClaimedTrial | None:
        """The next trial, claimed for this driver; None when there is none at the moment."""
        ...

    def is_exhausted(self, *, wait: bool) -> bool:
        """Whether no trial is left; with `wait`, whether other drivers have finished too."""
        ...


def trial_attributes(plan: PlannedPoint) -> Mapping[str, Any]:
    """What is stored with a trial of a point, beside its key."""
    return {
        names.LABEL: plan.point.label,
        names.OVERRIDES: [without_passwords(word) for word in plan.point.overrides],
        names.RUNS: [run.key for run in plan.runs],
        names.PIXELS: plan.pixel_factor,
    }
