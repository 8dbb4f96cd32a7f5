"""Estimate how much later one video began than another, by their motion, and pair their frames."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

# Width of the images whose differences are the motion, pixels.
WIDTH = 64

# Samples per second at which two motions are compared.
RATE_HZ = 50.0

# Least length in seconds that two motions have in common, and their least correlation.
LEAST_S, LEAST_CORRELATION = 2.0, 0.5

# An offset is estimated if no other one, farther than this, correlates within the margin.
APART_S, MARGIN = 0.5, 0.1


def small(frame: NDArray[Any]) -> NDArray[np.float32]:
    """Shrink a grey frame (H, W) to `WIDTH` columns, float32."""
    hw = WIDTH, max(1, round(WIDTH * frame.shape[0] / frame.shape[1]))
    shrunk = cv2.resize(frame.astype(np.float32), hw, interpolation=cv2.INTER_AREA)
    return np.asarray(shrunk, np.float32)


def motion(frames: Sequence[NDArray[np.float32]]) -> Floats:
    """Return the mean absolute difference of each frame to the one before; (T - 1,)."""
    images = np.asarray(frames, np.float64)
    return np.asarray(np.abs(np.diff(images, axis=0)).mean((1, 2)), np.float64)


def offset_of(first: Floats, second: Floats, rates_hz: tuple[float, float]) -> float | None:
    """Return how many seconds later the second video began; None if it cannot be estimated.

    `first` and `second` are `motion` at frame rates `rates_hz`. The offset has the highest
    correlation of both motions over the time in common, of offsets that leave `LEAST_S` seconds or
    half of the shorter video.
    """
    import pandas as pd  # rgbt --help answers without waiting for it

    one, other = (_resampled(*given) for given in zip((first, second), rates_hz, strict=True))
    least = int(max(LEAST_S * RATE_HZ, min(len(one), len(other)) / 2))
    shifts = np.arange(least - len(other), len(one) - least + 1)
    if not len(shifts):
        return None
    fixed, places = pd.Series(one), np.arange(len(other))
    found = np.array([fixed.corr(pd.Series(other, index=places + shift)) for shift in shifts])
    found = np.nan_to_num(found)  # of a still part
    best = int(found.argmax())
    others = found[np.abs(shifts - shifts[best]) > APART_S * RATE_HZ]
    if found[best] < max(LEAST_CORRELATION, others.max(initial=-1.0) + MARGIN):
        return None
    return float(shifts[best]) / RATE_HZ


def _resampled(values: Floats, rate_hz: float) -> Floats:
    """Return the logarithm at `RATE_HZ`; a difference is of the time between its two frames."""
    middles = (np.arange(len(values)) + 0.5) / rate_hz
    times = np.arange(0, len(values) / rate_hz, 1 / RATE_HZ)
    return np.asarray(np.log(np.interp(times, middles, values) + 1e-3), np.float64)


def paired(
    numbers: tuple[int, int], rates_hz: tuple[float, float], offset_s: float
) -> list[tuple[int, int]]:
    """Pair frames of two videos of these lengths: (index, index) of the slower one's frames.

    The partner is nearest in time, at most half a frame of the faster one away; the second video
    began `offset_s` seconds later.
    """
    slow = int(rates_hz[1] < rates_hz[0])
    later_s = (-offset_s, offset_s)[slow]
    frames = np.arange(numbers[slow])
    partners = np.rint((frames / rates_hz[slow] + later_s) * rates_hz[1 - slow]).astype(int)
    found = np.stack([frames, partners], 1)[(partners >= 0) & (partners < numbers[1 - slow])]
    return [(one, other) for one, other in (found[:, ::-1] if slow else found).tolist()]
