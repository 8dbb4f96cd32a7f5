"""Offset of two videos by their motion, and the frames that belong together."""

from __future__ import annotations

import numpy as np
import pytest

from rgbt.geometry.time_offset import motion, offset_of, paired


def speed(times: np.ndarray) -> np.ndarray:
    """A motion that does not repeat, from 0 to 1."""
    knots = np.random.default_rng(1).random(80)
    return np.interp(times, np.arange(80) * 0.5, knots)


def between(number: int, rate_hz: float, start_s: float) -> np.ndarray:
    """What `motion` sees of a video: half a frame after each frame but the last."""
    return speed(start_s + (np.arange(number - 1) + 0.5) / rate_hz)


@pytest.mark.parametrize("offset", [0.0, 1.36, -2.4])
def test_offset_of_two_frame_rates(offset: float) -> None:
    found = offset_of(between(300, 30, 5.0), 3 * between(90, 9, 5.0 + offset), (30, 9))
    assert found == pytest.approx(offset, abs=0.04)


def test_even_motion_tells_no_offset() -> None:
    assert offset_of(np.ones(200), np.ones(90), (30, 9)) is None
    turns = np.sin(np.arange(300) / 30 * 2 * np.pi) + 2  # repeats every second
    assert offset_of(turns, turns, (30, 30)) is None
    assert offset_of(between(30, 30, 0), between(30, 30, 0), (30, 30)) is None  # one second


def test_motion_is_the_mean_difference() -> None:
    frames = [np.zeros((2, 2), np.float32), np.array([[4, 0], [0, -4]], np.float32)]
    assert motion(frames).tolist() == [2.0]


def test_frames_of_one_time() -> None:
    # RGB at 0, 0.1, ..., 0.5 s; thermal at 0.15, 0.35, 0.55 s: 0.55 is 0.05 after the last.
    assert paired((6, 3), (10, 5), 0.14) == [(1, 0), (3, 1), (5, 2)]
    # The first one is slower; thermal began earlier, at -0.2 s.
    assert paired((2, 5), (5, 10), -0.2) == [(0, 2), (1, 4)]
    assert paired((3, 3), (10, 10), 5.0) == []
