from __future__ import annotations

import inspect
from typing import Any

import cv2
import numpy as np
import pytest
import yaml

from rgbt.config.component import build
from rgbt.config.compose import conf_dir
from rgbt.transforms.joint import View
from rgbt.transforms.thesis import ThesisTransform, area, mixed
from rgbt.types import IGNORE, Sample
from tests.models.golden import compose

HW = (64, 128)
HALF = (32, 64)


def thesis(**changes: Any) -> ThesisTransform:
    recipe: dict[str, Any] = {
        "crop_hw": HALF,
        "flip_probability": 0.5,
        "blur_probability": 0.0,
        "blur_kernel": 5,
        "label_resize": "nearest",
        "test_short_edge": HALF[0],
        "track_position": True,
    }
    return ThesisTransform(**{**recipe, **changes})


def sample(hw: tuple[int, int] = HW, *, labelled: bool = True) -> Sample:
    """Noise; the confidence of a pixel follows from its label and place."""
    rng = np.random.default_rng(0)
    label = rng.integers(0, 14, hw, dtype=np.uint8)
    place = np.arange(hw[0] * hw[1], dtype=np.float32).reshape(hw) / (hw[0] * hw[1])
    return Sample(
        rgb=rng.integers(0, 256, (*hw, 3), dtype=np.uint8),
        thermal=rng.integers(0, 256, hw, dtype=np.uint8),
        label=label if labelled else None,
        name="seq_00_day_00_1_2",
        confidence=place if labelled else None,
    )


def means(image: np.ndarray) -> np.ndarray:
    """Of squares of 2 x 2 pixels, halves rounded up."""
    parts = image.astype(int)
    total = parts[::2, ::2] + parts[1::2, ::2] + parts[::2, 1::2] + parts[1::2, 1::2]
    return (total + 2) // 4


@pytest.mark.parametrize("flipped", [False, True])
def test_half_the_size_is_the_mean_of_four_and_all_is_mirrored_together(flipped: bool) -> None:
    original = sample()
    assert original.label is not None
    assert original.confidence is not None
    example = thesis(flip_probability=float(flipped)).train(original, np.random.default_rng(1))
    step = -1 if flipped else 1
    np.testing.assert_array_equal(example.rgb, means(original.rgb)[:, ::step])
    np.testing.assert_array_equal(example.thermal, means(original.thermal)[:, ::step])
    # Nearest takes the first of two pixels.
    np.testing.assert_array_equal(example.label, original.label[::2, ::2][:, ::step])
    assert example.confidence is not None
    np.testing.assert_array_equal(example.confidence, original.confidence[::2, ::2][:, ::step])
    assert example.position is not None
    row, column = example.position.astype(int)
    np.testing.assert_array_equal(example.label, original.label[row, column])
    np.testing.assert_array_equal(example.confidence, original.confidence[row, column])


def test_mirrors_half_of_the_samples() -> None:
    rng, original = np.random.default_rng(2), sample()
    flips = 0
    for _ in range(200):
        position = thesis().train(original, rng).position
        assert position is not None
        flips += position[1, 0, 0] > position[1, 0, -1]
    assert 75 < flips < 125


@pytest.mark.parametrize("hw", [(32, 64), (64, 128), (40, 50), (20, 64), (33, 200)])
def test_always_the_same_size(hw: tuple[int, int]) -> None:
    example = thesis().train(sample(hw), np.random.default_rng(3))
    assert (example.rgb.shape, example.rgb.dtype) == ((*HALF, 3), np.uint8)
    assert (example.thermal.shape, example.thermal.dtype) == (HALF, np.uint8)
    assert (example.label.shape, example.label.dtype) == (HALF, np.uint8)
    assert example.confidence is not None
    assert (example.confidence.shape, example.confidence.dtype) == (HALF, np.float32)
    assert (example.original_hw, example.name) == (hw, "seq_00_day_00_1_2")


def test_images_of_the_size_of_the_crop_stay_as_they_are() -> None:
    original = sample(HALF)
    still = thesis(flip_probability=0.0, track_position=False)
    for example in (still.train(original, np.random.default_rng(4)), still.test(original)):
        np.testing.assert_array_equal(example.rgb, original.rgb)
        np.testing.assert_array_equal(example.thermal, original.thermal)
        np.testing.assert_array_equal(example.label, original.label)
        np.testing.assert_array_equal(example.confidence, original.confidence)
        assert example.position is None
        assert example.centre_yx == (16, 32)


def test_larger_images_are_bilinear() -> None:
    image = np.random.default_rng(5).integers(0, 256, (16, 100), dtype=np.uint8)
    view = View((16, 100), HALF, (0, 0), HALF)
    np.testing.assert_array_equal(area(view, image, np.uint8), view.bilinear(image, np.uint8))


def gaussian(image: np.ndarray) -> np.ndarray:
    """Binomial weights of five pixels along both axes, borders mirrored at the last pixel."""
    weights = np.array([1, 4, 6, 4, 1]) / 16
    padded = np.pad(image.astype(float), ((2, 2), (2, 2), *((0, 0),) * (image.ndim - 2)), "reflect")
    height, width = image.shape[:2]
    rows = sum(w * padded[i : i + height] for i, w in enumerate(weights))
    return np.asarray(sum(w * rows[:, i : i + width] for i, w in enumerate(weights)))


@pytest.mark.parametrize("flipped", [0.0, 1.0])
def test_rgb_and_thermal_are_blurred_together_and_nothing_else(flipped: float) -> None:
    original = sample()
    sharp = thesis(flip_probability=flipped).train(original, np.random.default_rng(6))
    blurred = thesis(flip_probability=flipped, blur_probability=1.0).train(
        original, np.random.default_rng(6)
    )
    for name in ("rgb", "thermal"):
        expected = gaussian(getattr(sharp, name))
        assert np.abs(getattr(blurred, name) - expected).max() <= 0.5
    np.testing.assert_array_equal(blurred.label, sharp.label)
    np.testing.assert_array_equal(blurred.confidence, sharp.confidence)


def test_half_of_the_samples_are_blurred() -> None:
    rng, original = np.random.default_rng(7), sample()
    transform = thesis(blur_probability=0.5, flip_probability=0.0)
    sharp = means(original.thermal)
    found = [transform.train(original, rng) for _ in range(200)]
    same = [np.array_equal(each.thermal, sharp) for each in found]
    assert 75 < sum(same) < 125
    rgb = means(original.rgb)
    assert same == [np.array_equal(each.rgb, rgb) for each in found]


def test_released_labels_are_mixed() -> None:
    """As a resize with OpenCV's default interpolation, which the thesis' code falls into."""
    original = sample()
    assert original.label is not None
    example = thesis(label_resize="bilinear", flip_probability=0.0).train(
        original, np.random.default_rng(8)
    )
    np.testing.assert_array_equal(example.label, cv2.resize(original.label, HALF[::-1]))
    borders = np.zeros(HW, np.uint8)
    borders[:, 33:] = 12  # the square of columns 32 and 33 holds road and background
    assert np.unique(mixed(View(HW, HALF, (0, 0), HALF), borders)).tolist() == [0, 6, 12]


def test_a_mix_with_an_ignored_pixel_is_ignored() -> None:
    label = np.full((2, 6), 3, np.uint8)
    label[0, 0] = IGNORE
    view = View((2, 6), (1, 3), (0, 0), (1, 3))
    assert mixed(view, label).tolist() == [[255, 3, 3]]
    bare = thesis(label_resize="bilinear").train(sample(labelled=False), np.random.default_rng(9))
    assert (bare.label == IGNORE).all()
    assert bare.confidence is None


def test_evaluation_keeps_the_label_of_the_file() -> None:
    original = sample()
    for changes in ({}, {"label_resize": "bilinear", "blur_probability": 1.0}):
        example = thesis(**changes).test(original)
        np.testing.assert_array_equal(example.rgb, means(original.rgb))
        np.testing.assert_array_equal(example.thermal, means(original.thermal))
        np.testing.assert_array_equal(example.label, original.label)
        np.testing.assert_array_equal(example.confidence, original.confidence)
    full = thesis(test_short_edge=None).test(original)
    np.testing.assert_array_equal(full.rgb, original.rgb)


def test_configurations_name_every_setting_and_differ_where_they_say() -> None:
    node = yaml.safe_load((conf_dir() / "transform" / "thesis.yaml").read_text())
    assert set(node) == {"_target_", *inspect.signature(ThesisTransform).parameters}
    size = "scale.crop_hw=[320,640]"
    plain, blur, released = (
        compose(f"transform={name}", size).transform
        for name in ("thesis", "thesis_blur", "thesis_released")
    )
    assert (plain.flip_probability, plain.blur_probability, plain.label_resize) == (
        *(0.5, 0.0, "nearest"),
    )
    assert (list(plain.crop_hw), plain.test_short_edge) == ([320, 640], 320)
    assert {key for key in plain if plain[key] != blur[key]} == {"blur_probability"}
    assert (blur.blur_probability, blur.blur_kernel) == (0.5, 5)
    assert {key for key in plain if plain[key] != released[key]} == {"label_resize"}
    smaller = build(compose("transform=thesis", size, "transform.crop_hw=[96,192]").transform)
    assert (smaller.crop_hw, smaller.test_short_edge) == ((96, 192), 96)
