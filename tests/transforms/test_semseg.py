"""The augmentation of semseg: every step alone, computed again with OpenCV's own calls."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.config.component import build
from rgbt.transforms.semseg import SemsegTransform
from rgbt.types import IGNORE, Example, Sample
from tests.composed import specified
from tests.models.golden import compose
from tests.transforms.test_thesis import HW, sample

MEAN = (123.675, 116.28, 103.53)
NOTHING: dict[str, Any] = {
    **{"scale_range": (1.0, 1.0), "rotate_probability": 0.0, "rotate_degrees": 10.0},
    **{"blur_probability": 0.0, "blur_kernel": 5, "flip_probability": 0.0, "crop_hw": HW},
    **{"padding_rgb": MEAN, "padding_thermal": 114.495, "test_short_edge": None},
}


def trained(original: Sample, number: int, **changes: Any) -> Example:
    return SemsegTransform(**{**NOTHING, **changes}).train(original, np.random.default_rng(number))


def assert_equal(example: Example, rgb: Any, label: Any) -> None:
    np.testing.assert_allclose(example.rgb, rgb, atol=2e-3)
    np.testing.assert_array_equal(example.label, label)


@pytest.mark.parametrize("number", range(3))
def test_scaled_images_are_those_of_opencv(number: int) -> None:
    original = sample()
    factor = float(np.random.default_rng(number).uniform(0.5, 2.0))
    size = (round(HW[1] * factor), round(HW[0] * factor))
    found = trained(original, number, scale_range=(0.5, 2.0), crop_hw=(size[1], size[0]))
    rgb = cv2.resize(original.rgb.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
    np.testing.assert_allclose(found.rgb, rgb, atol=2e-3)
    assert found.label.shape == (size[1], size[0])


@pytest.mark.parametrize("number", range(3))
def test_rotated_images_are_those_of_opencv(number: int) -> None:
    """About (w / 2, h / 2), with the mean colour and ignored labels outside."""
    original = sample()
    found = trained(original, number, rotate_probability=1.0)
    rng = np.random.default_rng(number)
    rng.uniform(1.0, 1.0), rng.random()
    angle = float(rng.uniform(-10, 10))
    matrix = cv2.getRotationMatrix2D((HW[1] / 2, HW[0] / 2), angle, 1)
    size = (HW[1], HW[0])
    rgb = cv2.warpAffine(
        original.rgb.astype(np.float32), matrix, size, borderMode=cv2.BORDER_CONSTANT,
        borderValue=MEAN, flags=cv2.INTER_LINEAR,
    )  # fmt: skip
    label = cv2.warpAffine(
        original.label, matrix, size, borderMode=cv2.BORDER_CONSTANT, borderValue=IGNORE,
        flags=cv2.INTER_NEAREST,
    )  # fmt: skip
    assert_equal(found, rgb, label)
    assert (found.label == IGNORE).any()
    np.testing.assert_array_equal(found.confidence[found.label == IGNORE], 0.0)


def test_small_images_are_padded_with_the_mean_colour() -> None:
    """64 x 128 in 73 x 138: 4 rows above and 5 below, 5 columns at either side."""
    original = sample()
    found = trained(original, 0, crop_hw=(73, 138))
    rgb = cv2.copyMakeBorder(
        original.rgb.astype(np.float32), 4, 5, 5, 5, cv2.BORDER_CONSTANT, value=MEAN
    )
    label = cv2.copyMakeBorder(original.label, 4, 5, 5, 5, cv2.BORDER_CONSTANT, value=IGNORE)
    assert_equal(found, rgb, label)
    assert found.thermal[0, 0] == np.float32(114.495)
    assert found.centre_yx == (4 + 32, 5 + 64)


def test_blur_and_mirror_take_images_and_labels_together() -> None:
    original = sample()
    found = trained(original, 1, blur_probability=1.0, flip_probability=1.0)
    rgb = cv2.GaussianBlur(original.rgb.astype(np.float32), (5, 5), 0)[:, ::-1]
    assert_equal(found, rgb, original.label[:, ::-1])
    np.testing.assert_array_equal(found.confidence, original.confidence[:, ::-1])
    assert found.centre_yx == (32, 127 - 64)


def test_crops_reach_every_place() -> None:
    place = np.add.outer(np.arange(3) * 50, np.arange(4)).astype(np.uint8)
    original = Sample(rgb=np.zeros((3, 4, 3), np.uint8), thermal=place, label=place, name="x")
    corners = {int(trained(original, n, crop_hw=(2, 3)).label[0, 0]) for n in range(60)}
    assert corners == {0, 1, 50, 51}
    example = trained(original, 0, crop_hw=(2, 3))
    np.testing.assert_array_equal(example.thermal, example.label)
    row, column = example.centre_yx
    assert abs(int(example.label[row, column]) - 52) <= 51


def test_unlabelled_images_are_ignored_everywhere() -> None:
    changes = {"rotate_probability": 1.0, "scale_range": (0.5, 2.0), "flip_probability": 0.5}
    for number in range(4):
        found = trained(sample(labelled=False), number, **changes)
        assert (found.label == IGNORE).all()
        assert found.confidence is None
        assert found.rgb.shape == (*HW, 3)


def test_evaluation_keeps_the_file() -> None:
    original = sample()
    example = SemsegTransform(**NOTHING).test(original)
    np.testing.assert_array_equal(example.rgb, original.rgb)
    np.testing.assert_array_equal(example.label, original.label)
    half = replace(SemsegTransform(**NOTHING), test_short_edge=32).test(original)
    assert half.rgb.shape == (32, 64, 3)


def test_published_numbers_of_the_teacher() -> None:
    """Configuration mv_pspnet50 of the thesis' code; batch and auxiliary weight of semseg."""
    made: SemsegTransform = build(
        compose("model=semseg", "transform=semseg", "scale.crop_hw=[473,473]").transform
    )
    assert (made.scale_range, made.rotate_degrees, made.crop_hw) == ((0.5, 2.0), 10.0, (473, 473))
    assert (made.rotate_probability, made.blur_probability, made.flip_probability) == (0.5,) * 3
    assert (made.blur_kernel, made.padding_rgb) == (5, MEAN)
    assert made.padding_thermal == pytest.approx(sum(MEAN) / 3)
    spec = specified(("+experiment=thermal_teacher_semseg", "scale=paper", "dataset.root=x"))
    optimizer = spec.optimizer.values
    assert (optimizer["lr"], optimizer["backbone_multiplier"]) == (0.1, 0.1)
    assert (optimizer["momentum"], optimizer["weight_decay"]) == (0.9, 1e-4)
    assert (spec.loss.values["weight"], spec.data.batch_size) == (0.4, 16)
    assert spec.trainer.max_steps == 400 * (12170 // 16)
    assert (spec.prediction.window_hw, spec.prediction.mirrored) == ((473, 473), True)
    assert spec.schedule.build()(152000, 304000, 760) == pytest.approx(0.5**0.9)
