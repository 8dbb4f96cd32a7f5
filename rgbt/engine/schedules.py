"""Learning rate schedules: a factor of the base rate as a function of the optimiser step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

from rgbt.checks import check_range


class Schedule(Protocol):
    """What the loop asks a schedule."""

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:
        """Factor of the base learning rate at optimiser step `step` (0-based)."""
        ...


@dataclass(frozen=True, kw_only=True)
class Poly:
    """Polynomial decay ``(1 - t / max_steps) ** power`` after a linear warm-up.

    Paper: CRM and SpatialSeg train with "poly", t counting iterations (`per: iteration`).
    Released: t counts epochs while the denominator stays in iterations (`per: epoch`), so the
    rate hardly falls: to 0.98-0.997 of its start at the end of training.

    Attributes:
        power: 0.9 in both releases.
        per: what t counts.
        warmup_steps: steps over which the factor rises linearly from 1 / warmup_steps to 1; the
            decay, counted from step 0, takes over after them (as in the temporal release).
    """

    power: float
    per: Literal["iteration", "epoch"]
    warmup_steps: int

    def __post_init__(self) -> None:
        check_range("schedule.power", self.power, 0.0, 100.0)
        check_range("schedule.warmup_steps", self.warmup_steps, 0, 2**40)

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:
        """See `Schedule`."""
        done = step if self.per == "iteration" else step // steps_per_epoch
        decay = max(0.0, 1.0 - done / max_steps) ** self.power
        return (step + 1) / self.warmup_steps if step < self.warmup_steps else float(decay)


@dataclass(frozen=True, kw_only=True)
class Exponential:
    """``factor ** epoch``, epochs counted from 0 and rounded down.

    Source: MFNet and RTFNet releases.

    Attributes:
        factor: 0.95 in both releases' code; MFNet's released weights were trained with 0.94.
        epoch_steps: length of an epoch in steps, where a release's list is longer than ours;
            null: the list's own.
    """

    factor: float
    epoch_steps: int | None

    def __post_init__(self) -> None:
        check_range("schedule.factor", self.factor, 0.0, 1.0)
        if self.epoch_steps is not None:
            check_range("schedule.epoch_steps", self.epoch_steps, 1, 2**40)

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """See `Schedule`."""
        return float(self.factor ** (step // (self.epoch_steps or steps_per_epoch)))
