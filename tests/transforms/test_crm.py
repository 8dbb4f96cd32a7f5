from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

from rgbt.transforms.crm import CrmTransform
from rgbt.transforms.joint import short_edge_hw, whole_view
from rgbt.types import Sample
from tests.transforms.recipes import crm

CONF = Path(__file__).resolve().parents[2] / "conf" / "transform"


def sample(hw: tuple[int, int] = (48, 64)) -> Sample:
    rng = np.random.default_rng(0)
    return Sample(
        rgb=rng.integers(0, 256, (*hw, 3), dtype=np.uint8),
        thermal=rng.integers(0, 256, hw, dtype=np.uint8),
        label=rng.integers(0, 9, hw, dtype=np.uint8),
        name="00001D",
    )


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


def test_none_returns_the_sample() -> None:
    node = yaml.safe_load((CONF / "none.yaml").read_text())
    del node["_target_"]
    original = sample()
    example = CrmTransform(**node).train(original, np.random.default_rng(0))
    np.testing.assert_array_equal(example.rgb, original.rgb)
    np.testing.assert_array_equal(example.thermal, original.thermal)
    np.testing.assert_array_equal(example.label, original.label)
