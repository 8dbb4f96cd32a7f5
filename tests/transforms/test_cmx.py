from __future__ import annotations

import itertools
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from rgbt.config.component import build
from rgbt.transforms.cmx import CmxTransform, draw_span, padded
from rgbt.transforms.example import viewed
from rgbt.transforms.joint import whole_view
from rgbt.types import IGNORE, Example, Sample
from tests.models.golden import compose

RGB, THERMAL = np.array([124, 116, 104]), 114


def cmx(**changes: Any) -> CmxTransform:
    recipe: dict[str, Any] = {
        "flip_probability": 0.5,
        "factors": (0.5, 0.75, 1.0, 1.25, 1.5, 1.75),
        "crop_hw": (48, 64),
        "padding_rgb": (123.675, 116.28, 103.53),
        "padding_order": "rgb",
        "padding_thermal": (123.675, 116.28, 103.53),
        "test_short_edge": None,
        "track_position": True,
    }
    return CmxTransform(**{**recipe, **changes})


def sample(hw: tuple[int, int] = (48, 64)) -> Sample:
    """Red is the row, green the column; thermal and labels are noise."""
    rng = np.random.default_rng(0)
    row, column = np.mgrid[: hw[0], : hw[1]].astype(np.uint8)
    return Sample(
        rgb=np.stack([row, column, row], axis=-1),
        thermal=rng.integers(0, 256, hw, dtype=np.uint8),
        label=rng.integers(0, 9, hw, dtype=np.uint8),
        name="00001D",
    )


def image_part(example: Example) -> np.ndarray:
    """Where the example is not padding (no label of the samples is 255)."""
    return example.label != IGNORE


def test_span_by_hand() -> None:
    rng = np.random.default_rng(1)
    assert {draw_span(4, 4, rng) for _ in range(20)} == {(0, 4)}
    assert {draw_span(3, 4, rng) for _ in range(20)} == {(0, 3)}
    drawn = [draw_span(6, 4, rng) for _ in range(4000)]
    # 0..3, and the last one lacks a pixel.
    assert set(drawn) == {(0, 4), (1, 4), (2, 4), (3, 3)}
    assert all(abs(drawn.count(span) - 1000) < 140 for span in set(drawn))


def test_padding_by_hand() -> None:
    small = Sample(
        rgb=np.full((1, 2, 3), 9, np.uint8),
        thermal=np.array([[1, 2]], np.uint8),
        label=np.array([[3, 4]], np.uint8),
        name="x",
    )
    example = viewed(small, whole_view((1, 2), (1, 2)), np.uint8, track_position=True)
    framed = padded(example, (2, 5), RGB, THERMAL)
    # One row more: below. Three columns more: one left, two right.
    assert framed.label.tolist() == [[255, 3, 4, 255, 255], [255] * 5]
    assert framed.thermal.tolist() == [[114, 1, 2, 114, 114], [114] * 5]
    assert framed.rgb[0, :, 0].tolist() == [124, 9, 9, 124, 124]
    assert framed.rgb[1, 4].tolist() == [124, 116, 104]
    assert framed.position is not None
    assert framed.position[1].tolist() == [[0, 0, 1, 1, 1]] * 2
    assert (example.centre_yx, framed.centre_yx) == ((0, 1), (0, 2))
    assert (framed.rgb.dtype, framed.thermal.dtype, framed.label.dtype) == (np.uint8,) * 3
    assert framed.position.dtype == np.float32


def test_always_the_size_of_the_crop() -> None:
    transform, rng = cmx(), np.random.default_rng(2)
    for hw in ((48, 64), (30, 90), (97, 41)):
        for _ in range(20):
            example = transform.train(sample(hw), rng)
            assert example.position is not None
            assert (example.rgb.shape, example.rgb.dtype) == ((48, 64, 3), np.uint8)
            assert (example.thermal.shape, example.thermal.dtype) == ((48, 64), np.uint8)
            assert (example.label.shape, example.position.shape) == ((48, 64), (2, 48, 64))
            assert (example.original_hw, example.name) == (hw, "00001D")


def test_label_comes_from_the_position_and_the_rest_is_padding() -> None:
    original, transform, rng = sample(), cmx(), np.random.default_rng(3)
    assert original.label is not None
    shares = set()
    for _ in range(200):
        example = transform.train(original, rng)
        assert example.position is not None
        inside = image_part(example)
        row, column = example.position.astype(int)
        np.testing.assert_array_equal(example.label[inside], original.label[row, column][inside])
        assert (example.rgb[~inside] == RGB).all()
        assert (example.thermal[~inside] == THERMAL).all()
        # Ramps: a pixel of the image shows its own row and column, to what resizing allows.
        assert np.abs(example.rgb[..., 0] - example.position[0])[inside].max() < 1.6
        assert np.abs(example.rgb[..., 1] - example.position[1])[inside].max() < 1.6
        distance = np.hypot(row - 24, column - 32)
        i, j = example.centre_yx
        assert (distance[i, j], inside[i, j]) == (distance.min(), True)
        shares.add(round(float(inside.mean()), 4))
    # Half the size: a quarter; three quarters: 9/16; larger: all, or a row or column less.
    less = {round(share, 4) for share in (47 / 48, 63 / 64, 47 / 48 * 63 / 64)}
    assert {0.25, 0.5625, 1.0} <= shares <= {0.25, 0.5625, 1.0, *less}


def outcomes(image: np.ndarray, factors: tuple[float, ...], crop: tuple[int, int], fill: int):
    """Every image that the release can make of one, by its steps: mirror, resize, crop, pad."""
    for mirrored, factor in itertools.product((False, True), factors):
        turned = np.ascontiguousarray(image[:, ::-1]) if mirrored else image
        size = int(image.shape[1] * factor), int(image.shape[0] * factor)
        resized = cv2.resize(turned, size, interpolation=cv2.INTER_LINEAR_EXACT)
        spans = [
            range(max(1, length - wanted + 2) if length > wanted else 1)
            for length, wanted in zip(resized.shape, crop)
        ]
        for top, left in itertools.product(*spans):
            cut = resized[top : top + crop[0], left : left + crop[1]]
            down, right = crop[0] - cut.shape[0], crop[1] - cut.shape[1]
            sides = (down // 2, down - down // 2, right // 2, right - right // 2)
            framed = cv2.copyMakeBorder(cut, *sides, cv2.BORDER_CONSTANT, value=fill)
            yield framed.tobytes()


def test_every_outcome_is_one_of_the_releases_and_all_of_them_come() -> None:
    factors, crop = (0.5, 1.0, 1.5), (5, 8)
    hw = (6, 8)
    noise = np.random.default_rng(4).integers(0, 256, hw, dtype=np.uint8)
    original = Sample(
        rgb=np.repeat(noise[..., None], 3, axis=2), thermal=noise, label=None, name="x"
    )
    expected = set(outcomes(noise, factors, crop, THERMAL))
    transform, rng = cmx(factors=factors, crop_hw=crop), np.random.default_rng(5)
    found = {transform.train(original, rng).thermal.tobytes() for _ in range(6000)}
    # Half: 3x4 has one place, whole: 6 rows have three, half again: 9x12 has 6 x 6; each mirrored.
    assert len(expected) == 2 * (1 + 3 + 36)
    assert found == expected


def test_mirroring_and_factors_are_as_likely_as_they_should_be() -> None:
    transform, rng = cmx(factors=(0.5, 0.75)), np.random.default_rng(6)
    half = mirrored = 0
    for _ in range(1000):
        example = transform.train(sample(), rng)
        assert example.position is not None
        half += image_part(example).mean() < 0.3
        mirrored += example.position[1, 24, 20] > example.position[1, 24, 40]
    assert abs(half - 500) < 80
    assert abs(mirrored - 500) < 80


def test_padding_follows_the_order_of_the_means() -> None:
    released = cmx(padding_order="bgr", factors=(0.5,))
    example = released.train(sample(), np.random.default_rng(7))
    assert example.rgb[0, 0].tolist() == [104, 116, 124]


@pytest.mark.parametrize("inputs", ["cmx", "cmx_released", "temporal", "crm", "unit"])
def test_padding_is_zero_for_the_network(inputs: str) -> None:
    """To half a grey level; thermal on the mean of its channels."""
    config = compose("model=cmx_tiny", f"model/inputs={inputs}", "transform=cmx_released")
    transform, normalise = build(config.transform), build(config.model.inputs)
    transform.factors = (0.5,)
    example = transform.train(sample((120, 160)), np.random.default_rng(8))
    outside = torch.from_numpy(~image_part(example))
    rgb = torch.from_numpy(example.rgb).permute(2, 0, 1)[None] / 255
    images = normalise(rgb, torch.from_numpy(example.thermal)[None, None] / 255)
    half_level = (0.5 / 255) / min(normalise.rgb_std.min(), normalise.thermal_std.min())
    assert outside.float().mean() == 0.75
    assert images.rgb[0][:, outside].abs().max() <= half_level * 1.001
    grey_levels = images.thermal[0][:, outside] * normalise.thermal_std.view(-1, 1) * 255
    assert grey_levels.mean(0).abs().max() <= 0.501
