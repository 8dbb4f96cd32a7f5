"""Learning rate schedules: a factor of the base rate as a function of the optimiser step."""

# ruff: noqa: D102 - calls are those of `Schedule`

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.ranges import NumSteps, NumStepsOrZero, Power, Share

# (step from 0, steps of the run, steps of an epoch) -> factor of the base learning rate.
Schedule = Callable[[int, int, int], float]


@dataclass(frozen=True, kw_only=True)
class Poly:
    """Polynomial decay ``(1 - t / max_steps) ** power`` after a linear warm-up.

    Paper: CRM and SpatialSeg train with "poly", t counting iterations. Released: t counts epochs
    while the denominator stays in iterations, so the rate hardly falls. The decay after the warm-up
    is counted from step 0 (temporal release).
    """

    power: Power
    per: Literal["iteration", "epoch"]
    warmup_steps: NumStepsOrZero

    def __call__(self, step: int, max_steps: int, steps_per_epoch: int) -> float:
        done = step if self.per == "iteration" else step // steps_per_epoch
        decay = max(0.0, 1.0 - done / max_steps) ** self.power
        return (step + 1) / self.warmup_steps if step < self.warmup_steps else float(decay)


@dataclass(frozen=True, kw_only=True)
class WarmupPoly:
    """Polynomial decay that begins where a linear warm-up ends, of a run that is counted as longer.

        t < w: start + (1 - start) t / w,   else ((T - t) / (T - w)) ** power
        T = max_steps counted_epochs / epochs

    w is `warmup_steps`. Source: CMNeXt release (DELIVER): one epoch more than are trained.
    """

    power: Power
    warmup_steps: NumStepsOrZero
    warmup_start: Share
    epochs: NumSteps
    counted_epochs: NumSteps

    def __post_init__(self) -> None:
        _check_at_least("counted_epochs", self.counted_epochs, "epochs", self.epochs)

    def __call__(self, step: int, max_steps: int, _: int) -> float:
        if step < self.warmup_steps:
            return self.warmup_start + (1 - self.warmup_start) * step / self.warmup_steps
        total = max_steps * self.counted_epochs / self.epochs
        return float(((total - step) / (total - self.warmup_steps)) ** self.power)


@dataclass(frozen=True, kw_only=True)
class ThesisPoly:
    """``(1 - t / max_steps) ** power``, iterations t counted from 1: the last step has rate 0.

    Source: thesis (J. Sun), code of all networks with one or two heads; power 0.9.
    """

    power: Power

    def __call__(self, step: int, max_steps: int, _: int) -> float:
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

    E is `epoch_steps`, C `counted_steps` and W of a run warmup_steps C / E. Source: CMX release
    (E = C), temporal release (E = 1568, C = 1874: computed from the 1873 images of another data
    set).
    """

    power: Power
    warmup_steps: NumStepsOrZero
    epochs: NumSteps
    epoch_steps: NumSteps
    counted_steps: NumSteps

    def __post_init__(self) -> None:
        _check_at_least("counted_steps", self.counted_steps, "epoch_steps", self.epoch_steps)

    def __call__(self, step: int, max_steps: int, _: int) -> float:
        if step == 0:
            return 1.0
        done = step - 1
        extra = (self.counted_steps - self.epoch_steps) * max_steps
        # t, W and T of the docstring times E * epochs: whole numbers, so that t = W is met exactly.
        count = done * self.epoch_steps * self.epochs + done * self.epochs // max_steps * extra
        warmup = self.warmup_steps * self.counted_steps * self.epochs
        total = max_steps * self.counted_steps * self.epochs
        return count / warmup if count < warmup else float((1.0 - count / total) ** self.power)


@dataclass(frozen=True, kw_only=True)
class Exponential:
    """``factor ** epoch``, epochs counted from 0 and rounded down (MFNet and RTFNet releases).

    `epoch_steps` is the length of an epoch of a release; None: that of our list.
    """

    factor: Share
    epoch_steps: NumSteps | None

    def __call__(self, step: int, _: int, steps_per_epoch: int) -> float:
        return float(self.factor ** (step // (self.epoch_steps or steps_per_epoch)))


@dataclass(frozen=True, kw_only=True)
class Steps:
    """``factor ** n``, n counting how often the share `every` of the run has passed, rounded down.

    Source: HeatNet release, 0.5 every 0.3 of the run (60 of 200 epochs).
    """

    factor: Share
    every: Annotated[float, Interval(ge=1e-6, le=1)]

    def __call__(self, step: int, max_steps: int, _: int) -> float:
        # As a fraction: 0.3 of 608400 steps are 182520, and not the float below.
        return float(self.factor ** (step // (Fraction(str(self.every)) * max_steps)))


def _check_at_least(key: str, value: int, other: str, least: int) -> None:
    if value < least:
        raise InputError(f"schedule.{key}={value} must be at least schedule.{other}={least}.")
