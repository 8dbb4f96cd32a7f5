"""What every transform promises, whatever it does to images."""

from __future__ import annotations

import inspect
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import yaml

from rgbt.config.component import build
from rgbt.config.compose import conf_dir
from rgbt.transforms.cmnext import CmnextTransform
from rgbt.transforms.cmx import CmxTransform, padded
from rgbt.transforms.crm import CrmTransform
from rgbt.transforms.example import viewed
from rgbt.transforms.joint import View
from rgbt.transforms.rtfnet import RtfnetTransform
from rgbt.transforms.thesis import ThesisTransform
from rgbt.types import IGNORE, Sample
from tests.models.golden import compose

HW = (48, 64)
SIZES = ("scale.crop_hw=[40,56]", "scale.train_sizes=[30,48,70]")


def sample(**changes: Any) -> Sample:
    """Labels 0..13, whose confidence is a fourteenth of them and one."""
    rng = np.random.default_rng(0)
    label = rng.integers(0, 14, HW, dtype=np.uint8)
    values: dict[str, Any] = {
        "rgb": rng.integers(0, 256, (*HW, 3), dtype=np.uint8),
        "thermal": rng.integers(0, 256, HW, dtype=np.uint8),
        "label": label,
        "name": "00001D",
        "confidence": ((label + 1) / 14).astype(np.float32),
    }
    return Sample(**{**values, **changes})


@pytest.fixture(
    scope="module",
    params=(
        *("crm", "crm_released", "flip", "none"),
        *("rtfnet_released", "cmx_released", "cmnext_released", "thesis"),
    ),
)
def made(request: pytest.FixtureRequest) -> Any:
    config = compose(f"transform={request.param}", *SIZES, "transform.track_position=true")
    return build(config.transform)


def test_examples_have_stated_shapes_and_dtypes(made: Any) -> None:
    rng = np.random.default_rng(1)
    for _ in range(20):
        example = made.train(sample(), rng)
        hw = example.label.shape
        assert (example.rgb.shape, example.thermal.shape) == ((*hw, 3), hw)
        assert example.rgb.dtype == example.thermal.dtype
        assert example.rgb.dtype in (np.uint8, np.float32)
        assert (example.rgb.min() >= 0) & (example.rgb.max() <= 255)
        assert example.label.dtype == np.uint8
        assert (example.position.shape, example.position.dtype) == ((2, *hw), np.float32)
        assert (example.original_hw, example.name) == (HW, "00001D")


def test_label_and_confidence_come_from_position(made: Any) -> None:
    original, rng = sample(), np.random.default_rng(2)
    for _ in range(40):
        example = made.train(original, rng)
        inside = example.label != IGNORE
        row, column = example.position.astype(int)
        np.testing.assert_array_equal(example.label[inside], original.label[row, column][inside])
        expected = np.where(inside, (example.label + 1.0) / 14, 0)
        np.testing.assert_allclose(example.confidence, expected, rtol=1e-6)
        assert example.confidence.dtype == np.float32
        distance = np.hypot(row - HW[0] // 2, column - HW[1] // 2)
        i, j = example.centre_yx
        assert (distance[i, j], inside[i, j]) == (distance.min(), True)


def test_same_generator_gives_same_example_and_no_other_draws(made: Any) -> None:
    before = np.random.get_state()[1].copy()  # noqa: NPY002
    one, other = (made.train(sample(), np.random.default_rng(3)) for _ in range(2))
    for key in ("rgb", "thermal", "label", "confidence", "position"):
        np.testing.assert_array_equal(getattr(one, key), getattr(other, key))
    assert one.centre_yx == other.centre_yx
    np.testing.assert_array_equal(np.random.get_state()[1], before)  # noqa: NPY002


def test_position_and_label_may_be_left_out(made: Any) -> None:
    bare = sample(label=None, confidence=None)
    tracked = made.train(bare, np.random.default_rng(4))
    assert (tracked.label == IGNORE).all()
    assert tracked.confidence is None
    assert made.test(bare).confidence is None
    example = replace(made, track_position=False).train(bare, np.random.default_rng(4))
    assert example.position is None
    assert example.centre_yx == tracked.centre_yx
    np.testing.assert_array_equal(example.rgb, tracked.rgb)


def test_evaluation_keeps_files_or_resizes_images_alone(made: Any) -> None:
    original = sample()
    example = replace(made, test_short_edge=None).test(original)
    for key in ("rgb", "thermal", "label", "confidence"):
        np.testing.assert_array_equal(getattr(example, key), getattr(original, key))
    assert example.centre_yx == (24, 32)
    smaller = replace(made, test_short_edge=24).test(original)
    assert (smaller.rgb.shape, smaller.thermal.shape) == ((24, 32, 3), (24, 32))
    assert smaller.position.shape == (2, 24, 32)
    np.testing.assert_array_equal(smaller.label, original.label)
    np.testing.assert_array_equal(smaller.confidence, original.confidence)


PUBLISHED: dict[str, tuple[Any, dict[str, Any]]] = {
    "crm": (
        CrmTransform,
        {
            **{"brightness_delta": 32, "hue_delta": 18, "max_size": 1920, "colour": "intended"},
            **dict.fromkeys(("contrast_range", "saturation_range"), [0.5, 1.5]),
            **dict.fromkeys(("flip_probability", "colour_probability"), 0.5),
            "thermal_contrast_range": [0.5, 1.5],
        },
    ),
    "crm_released": (CrmTransform, {"colour": "released"}),
    "none": (CrmTransform, {}),
    "rtfnet_released": (RtfnetTransform, {"flip_probability": 0.5, "cut_share": 0.1}),
    "cmx_released": (
        CmxTransform,
        {"factors": [0.5, 0.75, 1, 1.25, 1.5, 1.75], "flip_probability": 0.5},
    ),
    "cmnext_released": (
        CmnextTransform,
        {
            **dict.fromkeys(("colour_probability", "blur_probability"), 0.2),
            **{"flip_probability": 0.5, "blur_deviation": 0.8},
            **{"colour_range": [0.5, 1.5], "scale_range": [0.5, 2.0]},
        },
    ),
    "thesis": (ThesisTransform, {"flip_probability": 0.5, "label_resize": "nearest"}),
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_configuration_has_every_setting_and_published_numbers(name: str) -> None:
    kind, numbers = PUBLISHED[name]
    node = yaml.safe_load((conf_dir() / "transform" / f"{name}.yaml").read_text())
    if "defaults" not in node:
        assert set(node) == {"_target_", *inspect.signature(kind).parameters}
    assert {key: node[key] for key in numbers} == numbers


def test_confidence_mirrored_and_padded_by_hand() -> None:
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
