"""Schedules: those of the CMX and temporal releases against a loop, those of domain adaptation."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.engine.schedules import Exponential, LatePoly, Poly, Steps, ThesisPoly, WarmupPoly

LR = 6e-5
STEPS = 200 * 1568  # temporal release


def temporal(**changes: Any) -> LatePoly:
    values = {"power": 0.9, "warmup_steps": 10 * 1568, "epochs": 200}
    return LatePoly(**{**values, "epoch_steps": 1568, "counted_steps": 1874, **changes})


def rates_in_effect(epochs: int, real: int, counted: int, warmup_epochs: int) -> list[float]:
    """Rate of every step where it is set after the step from epoch * counted + iteration."""
    rates, rate = [], LR
    for epoch in range(epochs):
        for iteration in range(real):
            rates.append(rate)
            t = epoch * counted + iteration
            rate = LR * t / (warmup_epochs * counted)
            if t >= warmup_epochs * counted:
                rate = LR * (1 - t / (epochs * counted)) ** 0.9
    return [*rates, rate]  # the last one is written and never used


def test_rates_equal_those_of_loop_setting_them_after_steps() -> None:
    schedule = temporal()
    found = [LR * schedule(step, STEPS, 784) for step in range(STEPS + 1)]
    np.testing.assert_allclose(found, rates_in_effect(200, 1568, 1874, 10), rtol=1e-12)


def test_thesis_poly_counts_from_one_and_ends_at_zero() -> None:
    """Rates of the thesis at a quarter, half, three quarters and nine tenths of the run."""
    schedule = ThesisPoly(power=0.9)
    steps = 100 * 761
    rates = [2.5e-4 * schedule(share * steps // 100 - 1, steps, 761) for share in (25, 50, 75, 90)]
    assert rates == pytest.approx([1.9297e-4, 1.3397e-4, 7.179e-5, 3.147e-5], rel=1e-4)
    assert schedule(0, 10, 1) == pytest.approx(0.9**0.9)
    assert schedule(9, 10, 1) == schedule(0, 1, 1) == 0.0


@pytest.mark.parametrize("every", [0.1, 0.2, 0.3, 0.6, 0.7, 0.14, 0.29, 0.57])
@pytest.mark.parametrize("steps", [10, 100, 700, 608400])
def test_shares_are_counted_as_they_are_written(every: float, steps: int) -> None:
    """In hundredths: 0.3 of 10 steps are 3, where floats say 3 - 4e-16 of three times 0.1."""
    schedule, hundredths = Steps(factor=0.5, every=every), round(100 * every)
    near = {n * hundredths * steps // 100 + off for n in range(12) for off in (-1, 0, 1)}
    for step in sorted(number for number in near if 0 <= number < steps):
        assert schedule(step, steps, 1) == 0.5 ** (100 * step // (hundredths * steps))


def test_poly_values() -> None:
    iteration = Poly(power=1.0, per="iteration", warmup_steps=0)
    assert [iteration(s, 4, 2) for s in range(4)] == [1.0, 0.75, 0.5, 0.25]
    # As released: 312 epochs of 112 iterations against a total of 35000 iterations.
    released = Poly(power=0.9, per="epoch", warmup_steps=0)
    assert released(34999, 35000, 112) == pytest.approx(0.992, abs=5e-4)
    warm = Poly(power=0.9, per="iteration", warmup_steps=4)
    assert [warm(step, 10**9, 1) for step in (0, 3)] == pytest.approx([0.25, 1.0])


def test_exponential_falls_by_the_epoch() -> None:
    own, longer = (Exponential(factor=0.5, epoch_steps=steps) for steps in (None, 6))
    assert [own(step, 100, 3) for step in range(7)] == [1, 1, 1, 0.5, 0.5, 0.5, 0.25]
    assert [longer(step, 100, 3) for step in range(7)] == [1] * 6 + [0.5]


def cmnext(**changes: Any) -> WarmupPoly:
    values = {"power": 0.9, "warmup_steps": 490, "warmup_start": 0.1}
    return WarmupPoly(**{**values, "epochs": 500, "counted_epochs": 501, **changes})


def test_warmup_poly_is_that_of_a_loop_over_epochs() -> None:
    """500 epochs of 49 steps: 10 of warm-up, and a decay that would end with epoch 501."""
    schedule, expected = cmnext(), []
    for t in range(500 * 49):
        if t < 10 * 49:
            expected.append(0.1 + 0.9 * t / (10 * 49))
        else:
            expected.append((1 - (t - 10 * 49) / (501 * 49 - 10 * 49)) ** 0.9)
    np.testing.assert_allclose([schedule(t, 24500, 112) for t in range(24500)], expected)


def test_counts_below_those_of_a_run_are_refused() -> None:
    with pytest.raises(InputError, match="schedule.counted_steps=1567 must be at least"):
        temporal(counted_steps=1567)
    with pytest.raises(InputError, match="schedule.counted_epochs=499 must be at least"):
        cmnext(counted_epochs=499)
