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


def test_every_rate_is_that_of_a_loop_that_writes_it_after_the_step() -> None:
    expected = rates_in_effect(200, 1568, 1874, 10)
    schedule = temporal()
    found = [LR * schedule(step, STEPS, 784) for step in range(STEPS + 1)]
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_published_values_where_an_epoch_is_counted_as_long_as_it_is() -> None:
    """Index t is in effect at step t + 1."""
    schedule = temporal(warmup_steps=18740, epoch_steps=1874)
    at = {t: LR * schedule(t + 1, 200 * 1874, 1) for t in (0, 1, 18739, 18740)}
    assert at[0] == 0
    assert at[1] == pytest.approx(3.2017e-9, rel=1e-5)
    assert at[18739] == pytest.approx(5.99968e-5, rel=1e-6)
    assert at[18740] == pytest.approx(5.72931e-5, rel=1e-6)


def test_published_values_of_the_run_whose_count_jumps() -> None:
    schedule = temporal()
    rate = [LR * schedule(step, STEPS, 784) for step in range(1570)]
    assert rate[:2] == [LR, 0.0]
    assert rate[2] == pytest.approx(3.2017e-9, rel=1e-5)
    assert rate[1568] == pytest.approx(5.02e-6, rel=1e-3)  # t = 1567, last of epoch 0
    assert rate[1569] == pytest.approx(6.0e-6, rel=1e-12)  # t = 1874, first of epoch 1
    # The warm-up never ends: t jumps from 18433 (epoch 9, step 1567) to 18740.
    assert LR * schedule(15680, STEPS, 784) == pytest.approx(LR * 18433 / 18740, rel=1e-12)
    assert LR * schedule(15681, STEPS, 784) == pytest.approx(5.72931e-5, rel=1e-6)
    assert LR * schedule(STEPS, STEPS, 784) == pytest.approx(1.0004e-7, rel=1e-4)


def test_a_tenth_of_the_steps_keeps_the_shape() -> None:
    """Same share of the run, same factor, up to the length of a step."""
    whole, tenth = temporal(), temporal(warmup_steps=1568)
    for step in range(1, STEPS // 10, 997):
        found = tenth(step + 1, STEPS // 10, 150)
        assert found == pytest.approx(whole(10 * step + 1, STEPS, 784), rel=1e-9)


def test_thesis_poly_counts_from_one_and_ends_at_zero() -> None:
    """Rates of the thesis at a quarter, half, three quarters and nine tenths of the run."""
    schedule = ThesisPoly(power=0.9)
    steps = 100 * 761
    rates = [2.5e-4 * schedule(share * steps // 100 - 1, steps, 761) for share in (25, 50, 75, 90)]
    assert rates == pytest.approx([1.9297e-4, 1.3397e-4, 7.179e-5, 3.147e-5], rel=1e-4)
    assert schedule(0, 10, 1) == pytest.approx(0.9**0.9)
    assert schedule(9, 10, 1) == 0.0
    assert schedule(0, 1, 1) == 0.0
    poly = Poly(power=0.9, per="iteration", warmup_steps=0)
    assert [schedule(step, 50, 7) for step in range(49)] == [
        poly(step + 1, 50, 7) for step in range(49)
    ]


def test_steps_halve_the_rate_every_sixty_of_two_hundred_epochs() -> None:
    schedule = Steps(factor=0.5, every=0.3)
    for epoch_steps in (1, 7, 3042):
        total = 200 * epoch_steps
        for epoch, expected in ((0, 1), (59, 1), (60, 0.5), (120, 0.25), (179, 0.25), (180, 0.125)):
            first, last = epoch * epoch_steps, (epoch + 1) * epoch_steps - 1
            assert schedule(first, total, epoch_steps) == expected
            assert schedule(last, total, epoch_steps) == expected
    assert [schedule(step, 10, 1) for step in range(10)] == [
        *[1.0] * 3, *[0.5] * 3, *[0.25] * 3, 0.125
    ]  # fmt: skip
    assert Steps(factor=0.5, every=1.0)(99, 100, 1) == 1.0


@pytest.mark.parametrize("every", [0.1, 0.2, 0.3, 0.6, 0.7, 0.14, 0.29, 0.57])
@pytest.mark.parametrize("steps", [10, 100, 700, 608400])
def test_shares_are_counted_as_they_are_written(every: float, steps: int) -> None:
    """In hundredths: 0.3 of 10 steps are 3, where floats say 3 - 4e-16 of three times 0.1."""
    schedule, hundredths = Steps(factor=0.5, every=every), round(100 * every)
    near = {n * hundredths * steps // 100 + off for n in range(12) for off in (-1, 0, 1)}
    for step in sorted(each for each in near if 0 <= each < steps):
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
    schedule, found, expected = cmnext(), [], []
    for epoch in range(500):
        for iteration in range(49):
            t = epoch * 49 + iteration
            if t < 10 * 49:
                expected.append(LR * (0.1 + 0.9 * t / (10 * 49)))
            else:
                expected.append(LR * (1 - (t - 10 * 49) / (501 * 49 - 10 * 49)) ** 0.9)
            found.append(LR * schedule(t, 24500, 112))
    np.testing.assert_allclose(found, expected, rtol=1e-12)
    assert (found[0], found[490], max(found)) == (LR * 0.1, LR, LR)
    assert found[-1] == pytest.approx(LR * (50 / (491 * 49)) ** 0.9)


def test_counts_below_those_of_a_run_are_refused() -> None:
    with pytest.raises(InputError, match="schedule.counted_steps=1567 must be at least"):
        temporal(counted_steps=1567)
    with pytest.raises(InputError, match="schedule.counted_epochs=499 must be at least"):
        cmnext(counted_epochs=499)
