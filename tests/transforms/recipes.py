"""Samples of noise, and the recipes of the transforms at a small size."""

from __future__ import annotations

from typing import Any

import numpy as np

from rgbt.transforms.crm import CrmTransform
from rgbt.types import Sample

RECIPE: dict[str, Any] = {
    **dict.fromkeys(("contrast_range", "saturation_range", "thermal_contrast_range"), (0.5, 1.5)),
    "brightness_delta": 32.0,
    "hue_delta": 18,
    "colour_probability": 0.5,
    "colour": "intended",
    "sizes": (24, 30, 48, 61, 96),
    "max_size": 192,
    "crop_hw": (24, 32),
    "flip_probability": 0.5,
    "test_short_edge": None,
    "track_position": True,
}
SIZES = ((48, 64), (60, 50), (31, 77), (97, 41), (64, 128), (33, 200))


def crm(**changes: Any) -> CrmTransform:
    return CrmTransform(**{**RECIPE, **changes})


def noise(number: int = 0, hw: tuple[int, int] = (48, 64), **changes: Any) -> Sample:
    """Labels 0..13 and 255; the confidence of every pixel is its own."""
    rng = np.random.default_rng(number)
    label = rng.integers(0, 14, hw, dtype=np.uint8)
    label[rng.random(hw) < 0.05] = 255
    values: dict[str, Any] = {
        "rgb": rng.integers(0, 256, (*hw, 3), dtype=np.uint8),
        "thermal": rng.integers(0, 256, hw, dtype=np.uint8),
        "label": label,
        "name": f"{number}",
        "confidence": rng.random(hw, dtype=np.float32),
    }
    return Sample(**{**values, **changes})
