"""The recipe of CRM at a small size."""

from __future__ import annotations

from typing import Any

from rgbt.transforms.crm import CrmTransform

JITTER: dict[str, Any] = {
    "brightness_delta": 32.0,
    "contrast_range": (0.5, 1.5),
    "saturation_range": (0.5, 1.5),
    "hue_delta": 18,
    "thermal_contrast_range": (0.5, 1.5),
}
RECIPE: dict[str, Any] = {
    **JITTER,
    "sizes": (24, 30, 48, 61, 96),
    "max_size": 192,
    "crop_hw": (24, 32),
    "flip_probability": 0.5,
    "colour": "intended",
    "colour_probability": 0.5,
    "test_short_edge": None,
    "track_position": True,
}


def crm(**changes: Any) -> CrmTransform:
    return CrmTransform(**{**RECIPE, **changes})
