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
        warmup_steps: steps over which the factor rises linearly from 1 / warmup_steps.
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
        warmup = min(1.0, (step + 1) / self.warmup_steps) if self.warmup_steps else 1.0
        return float(decay * warmup)


@dataclass(frozen=True, kw_only=True)
class Exponential:
    """``factor ** epoch``, epochs counted from 0.

    Source: MFNet and RTFNet releases.

    Attributes:
        factor: 0.95 in both releases' code; MFNet's released weights were trained with 0.94.
    """

    factor: float

    def __post_init__(self) -> None:
        check_range("schedule.factor", self.factor, 0.0, 1.0)

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """See `Schedule`."""
        return float(self.factor ** (step // steps_per_epoch))
