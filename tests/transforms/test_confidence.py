"""Every transform moves confidences as it moves the labels that they belong to."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from rgbt.config.component import build
from rgbt.transforms.cmx import padded
from rgbt.transforms.example import viewed
from rgbt.transforms.joint import View
from rgbt.types import IGNORE, Sample
from tests.models.golden import compose

HW = (48, 64)
TRANSFORMS = ("crm", "crm_released", "flip", "none", "rtfnet_released", "cmx_released", "thesis")


def sample(**changes: Any) -> Sample:
    """Labels 0..13, whose confidence is a fourteenth of them and one."""
    label = np.random.default_rng(0).integers(0, 14, HW, dtype=np.uint8)
    values: dict[str, Any] = {
        "rgb": np.zeros((*HW, 3), np.uint8),
        "thermal": np.zeros(HW, np.uint8),
        "label": label,
        "name": "a",
        "confidence": ((label + 1) / 14).astype(np.float32),
    }
    return Sample(**{**values, **changes})


@pytest.mark.parametrize("name", TRANSFORMS)
def test_a_confidence_stays_with_its_label(name: str) -> None:
    sizes = ("scale.crop_hw=[40,56]", "scale.train_sizes=[30,48,70]")
    transform = build(compose(f"transform={name}", *sizes).transform)
    rng = np.random.default_rng(1)
    for _ in range(40):
        example = transform.train(sample(), rng)
        assert example.confidence is not None
        assert example.confidence.dtype == np.float32
        expected = np.where(example.label == IGNORE, 0, (example.label + 1.0) / 14)
        np.testing.assert_allclose(example.confidence, expected, rtol=1e-6)
    shown = transform.test(sample())
    np.testing.assert_array_equal(shown.confidence, sample().confidence)


@pytest.mark.parametrize("name", TRANSFORMS)
def test_labels_without_confidence_stay_without(name: str) -> None:
    transform = build(compose(f"transform={name}").transform)
    bare = sample(confidence=None)
    assert transform.train(bare, np.random.default_rng(2)).confidence is None
    assert transform.test(bare).confidence is None


def test_mirrored_by_hand() -> None:
    small = sample(
        rgb=np.arange(6, dtype=np.uint8).reshape(1, 2, 3),
        thermal=np.array([[1, 2]], np.uint8),
        label=np.array([[3, 4]], np.uint8),
        confidence=np.array([[0.25, 0.75]], np.float32),
    )
    view = View((1, 2), (1, 2), (0, 0), (1, 2), flipped=True)
    example = viewed(small, view, np.uint8, track_position=False)
    assert example.label.tolist() == [[4, 3]]
    assert example.confidence is not None
    assert example.confidence.tolist() == [[0.75, 0.25]]
    framed = padded(example, (1, 4), np.zeros(3), 0)
    assert framed.label.tolist() == [[255, 4, 3, 255]]
    assert framed.confidence is not None
    assert framed.confidence.tolist() == [[0, 0.75, 0.25, 0]]
