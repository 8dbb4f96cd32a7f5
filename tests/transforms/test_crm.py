from __future__ import annotations

import inspect
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from rgbt.transforms.crm import CrmTransform
from rgbt.transforms.joint import short_edge_hw, whole_view
from rgbt.types import IGNORE, Sample

CONF = Path(__file__).resolve().parents[2] / "conf" / "transform"

RECIPE: dict[str, Any] = {
    "sizes": tuple(range(24, 97, 8)),
    "max_size": 192,
    "crop_hw": (24, 32),
    "flip_probability": 0.5,
    "colour": "intended",
    "colour_probability": 0.5,
    "brightness_delta": 32.0,
    "contrast_range": (0.5, 1.5),
    "saturation_range": (0.5, 1.5),
    "hue_delta": 18,
    "thermal_contrast_range": (0.5, 1.5),
    "test_short_edge": None,
    "track_position": True,
}


def crm(**changes: Any) -> CrmTransform:
    return CrmTransform(**{**RECIPE, **changes})


def sample(hw: tuple[int, int] = (48, 64)) -> Sample:
    rng = np.random.default_rng(0)
    return Sample(
        rgb=rng.integers(0, 256, (*hw, 3), dtype=np.uint8),
        thermal=rng.integers(0, 256, hw, dtype=np.uint8),
        label=rng.integers(0, 9, hw, dtype=np.uint8),
        name="00001D",
    )


@pytest.mark.parametrize(("colour", "dtype"), [("intended", np.uint8), ("released", np.float32)])
def test_shapes_dtypes_and_range(colour: str, dtype: Any) -> None:
    transform, rng = crm(colour=colour), np.random.default_rng(0)
    for _ in range(20):
        example = transform.train(sample(), rng)
        assert (example.rgb.shape, example.rgb.dtype) == ((24, 32, 3), dtype)
        assert (example.thermal.shape, example.thermal.dtype) == ((24, 32), dtype)
        assert (example.label.shape, example.label.dtype) == ((24, 32), np.uint8)
        assert example.position is not None
        assert (example.position.shape, example.position.dtype) == ((2, 24, 32), np.float32)
        assert (example.original_hw, example.name) == ((48, 64), "00001D")
        assert example.rgb.min() >= 0
        assert example.rgb.max() <= 255


@pytest.mark.parametrize("colour", ["intended", "released"])
def test_label_comes_from_the_position(colour: str) -> None:
    original, transform, rng = sample(), crm(colour=colour), np.random.default_rng(1)
    assert original.label is not None
    for _ in range(50):
        example = transform.train(original, rng)
        assert example.position is not None
        row, column = example.position.astype(int)
        np.testing.assert_array_equal(example.label, original.label[row, column])


def test_images_follow_the_position_where_nothing_is_interpolated() -> None:
    """Original size, no colour: RGB, thermal and label are the pixels that `position` names."""
    original = sample()
    transform = crm(sizes=(48,), colour_probability=0.0)
    rng = np.random.default_rng(2)
    for _ in range(20):
        example = transform.train(original, rng)
        assert example.position is not None
        row, column = example.position.astype(int)
        np.testing.assert_array_equal(example.rgb, original.rgb[row, column])
        np.testing.assert_array_equal(example.thermal, original.thermal[row, column])


def test_every_size_is_drawn_and_the_long_edge_is_limited() -> None:
    transform = crm(sizes=(24, 48, 96), crop_hw=None, max_size=100, colour_probability=0.0)
    rng = np.random.default_rng(3)
    shapes = [transform.train(sample(), rng).label.shape for _ in range(300)]
    counts = {shape: shapes.count(shape) for shape in set(shapes)}
    assert set(counts) == {(24, 32), (48, 64), (75, 100)}
    assert min(counts.values()) > 60


def test_released_values_are_not_rounded() -> None:
    transform = crm(colour="released", sizes=(33,), colour_probability=0.0, crop_hw=None)
    example = transform.train(sample(), np.random.default_rng(4))
    assert (example.rgb != np.round(example.rgb)).any()


def test_crop_is_clipped_to_the_image() -> None:
    example = crm(sizes=(16,)).train(sample(), np.random.default_rng(5))
    assert example.rgb.shape == (16, 21, 3)


def test_without_a_label_everything_is_ignored() -> None:
    full = sample()
    unlabelled = Sample(rgb=full.rgb, thermal=full.thermal, label=None, name="x")
    example = crm().train(unlabelled, np.random.default_rng(6))
    assert (example.label == IGNORE).all()


def test_same_generator_same_example() -> None:
    one, other = (crm().train(sample(), np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(one.rgb, other.rgb)
    np.testing.assert_array_equal(one.label, other.label)
    assert one.centre_yx == other.centre_yx


def test_tracking_can_be_left_out() -> None:
    example = crm(track_position=False).train(sample(), np.random.default_rng(8))
    assert example.position is None
    assert len(example.centre_yx) == 2


def test_evaluation_leaves_the_file_as_it_is() -> None:
    original = sample()
    example = crm().test(original)
    np.testing.assert_array_equal(example.rgb, original.rgb)
    np.testing.assert_array_equal(example.thermal, original.thermal)
    np.testing.assert_array_equal(example.label, original.label)
    assert example.centre_yx == (24, 32)


@pytest.mark.parametrize("colour", ["intended", "released"])
def test_evaluation_resizes_images_only(colour: str) -> None:
    original = sample()
    example = crm(colour=colour, test_short_edge=36).test(original)
    assert example.rgb.shape == (36, 48, 3)
    assert example.thermal.shape == (36, 48)
    assert example.position is not None
    assert example.position.shape == (2, 36, 48)
    np.testing.assert_array_equal(example.label, original.label)
    view = whole_view((48, 64), short_edge_hw((48, 64), 36, None))
    np.testing.assert_array_equal(example.rgb, view.bilinear(original.rgb, example.rgb.dtype))


@pytest.mark.parametrize("name", ["crm", "none"])
def test_configurations_name_every_setting(name: str) -> None:
    node = yaml.safe_load((CONF / f"{name}.yaml").read_text())
    assert set(node) == {"_target_", *inspect.signature(CrmTransform).parameters}


def test_configuration_holds_the_published_numbers() -> None:
    node = yaml.safe_load((CONF / "crm.yaml").read_text())
    assert node["brightness_delta"] == 32
    assert node["contrast_range"] == node["saturation_range"] == [0.5, 1.5]
    assert node["hue_delta"] == 18
    assert node["thermal_contrast_range"] == [0.5, 1.5]
    assert node["flip_probability"] == node["colour_probability"] == 0.5
    assert node["max_size"] == 1920
    released = yaml.safe_load((CONF / "crm_released.yaml").read_text())
    assert released["colour"] == "released"


def test_none_returns_the_sample() -> None:
    node = yaml.safe_load((CONF / "none.yaml").read_text())
    del node["_target_"]
    original = sample()
    example = CrmTransform(**node).train(original, np.random.default_rng(0))
    np.testing.assert_array_equal(example.rgb, original.rgb)
    np.testing.assert_array_equal(example.thermal, original.thermal)
    np.testing.assert_array_equal(example.label, original.label)
