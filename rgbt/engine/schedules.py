"""Learning rate schedules: a factor of the base rate as a function of the optimiser step."""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal, Protocol

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.ranges import NumSteps, NumStepsOrZero, Power, Share


class Schedule(Protocol):
    """The interface of a schedule."""

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
            decay, counted from step 0, follows (as in the temporal release).
    """

    power: Power
    per: Literal["iteration", "epoch"]
    warmup_steps: NumStepsOrZero

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:
        """Factor of the base learning rate at `step`."""
        done = step if self.per == "iteration" else step // steps_per_epoch
        decay = max(0.0, 1.0 - done / max_steps) ** self.power
        return (step + 1) / self.warmup_steps if step < self.warmup_steps else float(decay)


@dataclass(frozen=True, kw_only=True)
class WarmupPoly:
    """Polynomial decay that begins where a linear warm-up ends, of a run that is counted as longer.

        t < w: start + (1 - start) t / w,   else ((T - t) / (T - w)) ** power
        T = max_steps counted_epochs / epochs

    Source: CMNeXt release (DELIVER), whose T has one epoch more than are trained.

    Attributes:
        power: 0.9 there.
        warmup_steps: w, steps of the linear warm-up.
        warmup_start: factor of the first step of the warm-up; 0.1 there.
        epochs: that the run is divided into; 500 there.
        counted_epochs: that the decay is counted over, >= epochs; 501 there.
    """

    power: Power
    warmup_steps: NumStepsOrZero
    warmup_start: Share
    epochs: NumSteps
    counted_epochs: NumSteps

    def __post_init__(self) -> None:
        if self.counted_epochs < self.epochs:
            raise InputError(
                f"schedule.counted_epochs={self.counted_epochs} must be at least "
                f"schedule.epochs={self.epochs}; see rgbt.engine.schedules.WarmupPoly."
            )

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """Factor of the base learning rate at `step`."""
        if step < self.warmup_steps:
            return self.warmup_start + (1 - self.warmup_start) * step / self.warmup_steps
        total = max_steps * self.counted_epochs / self.epochs
        return float(((total - step) / (total - self.warmup_steps)) ** self.power)


@dataclass(frozen=True, kw_only=True)
class ThesisPoly:
    """``(1 - t / max_steps) ** power``, iterations t counted from 1: the last step has rate 0.

    Source: thesis (J. Sun), code of all networks with one or two heads.

    Attributes:
        power: 0.9 there.
    """

    power: Power

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """Factor of the base learning rate at `step`."""
        return float((1.0 - (step + 1) / max_steps) ** self.power)


@dataclass(frozen=True, kw_only=True)
class LatePoly:
    """Polynomial decay of the CMX and temporal releases, which set every rate after its step.

    The first step uses the full base rate. Step s, which is step i of epoch e (all from 0), sets
    the rate of the step after it from a count t, in which an epoch of E steps counts as C:

        t = C e + i,  T = C epochs,  W = C (epochs of warm-up)
        factor = t / W where t < W, else (1 - t / T) ** power

    So the second step has rate 0, and where C > E, t jumps by C - E at the start of every epoch.
    A run of n steps, other than the E epochs of the release, keeps the shape of its curve:

        t = s + e (C / E - 1) n / epochs,  e = floor(s epochs / n),  T = n C / E

    Source: CMX release (E = C), temporal release (E = 1568, C = 1874: computed from the 1873
    images of another data set).

    Attributes:
        power: 0.9 in both releases.
        warmup_steps: of the run, whose W is then warmup_steps C / E.
        epochs: that the run is divided into.
        epoch_steps: E, >= 1.
        counted_steps: C, >= E.
    """

    power: Power
    warmup_steps: NumStepsOrZero
    epochs: NumSteps
    epoch_steps: NumSteps
    counted_steps: NumSteps

    def __post_init__(self) -> None:
        if self.counted_steps < self.epoch_steps:
            raise InputError(
                f"schedule.counted_steps={self.counted_steps} must be at least "
                f"schedule.epoch_steps={self.epoch_steps}; see rgbt.engine.schedules.LatePoly."
            )

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """Factor of the base learning rate at `step`."""
        if step == 0:
            return 1.0
        done = step - 1
        epoch = done * self.epochs // max_steps
        # t, W and T of the docstring times E * epochs: whole numbers, so that t = W is met exactly.
        extra = (self.counted_steps - self.epoch_steps) * max_steps
        count = done * self.epoch_steps * self.epochs + epoch * extra
        warmup = self.warmup_steps * self.counted_steps * self.epochs
        total = max_steps * self.counted_steps * self.epochs
        return count / warmup if count < warmup else float((1.0 - count / total) ** self.power)


@dataclass(frozen=True, kw_only=True)
class Exponential:
    """``factor ** epoch``, epochs counted from 0 and rounded down.

    Source: MFNet and RTFNet releases.

    Attributes:
        factor: 0.95 in both releases' code; MFNet's released weights were trained with 0.94.
        epoch_steps: length of an epoch in steps, where the list of a release is longer than that
            of rgbt; null: the length of the list.
    """

    factor: Share
    epoch_steps: NumSteps | None

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """Factor of the base learning rate at `step`."""
        return float(self.factor ** (step // (self.epoch_steps or steps_per_epoch)))


@dataclass(frozen=True, kw_only=True)
class Steps:
    """``factor ** n``, n counting how often a share of the run has passed, rounded down.

    Source: HeatNet release (half every 60 of 200 epochs).

    Attributes:
        factor: in [0, 1]; 0.5 there.
        every: share of the run, in (0, 1]; 0.3 there.
    """

    factor: Share
    every: Annotated[float, Interval(ge=1e-6, le=1)]

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:  # noqa: ARG002
        """Factor of the base learning rate at `step`."""
        # As a fraction: 0.3 of 608400 steps are 182520, and not the float below.
        return float(self.factor ** (step // (Fraction(str(self.every)) * max_steps)))
