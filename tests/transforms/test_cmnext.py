"""The augmentation of the CMNeXt release: values by second computations, where crops lie, odds."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from rgbt.transforms.cmnext import CmnextTransform, draw_offset, recoloured
from rgbt.types import IGNORE, Sample

PLAIN = {
    **{"colour_probability": 0.0, "flip_probability": 0.0, "blur_probability": 0.0},
    **{"colour_range": (0.5, 1.5), "blur_deviation": 0.8, "scale_range": (1.0, 1.0)},
    **{"crop_hw": (12, 16), "test_short_edge": None, "track_position": True},
}


def cmnext(**changes: Any) -> CmnextTransform:
    return CmnextTransform(**{**PLAIN, **changes})


def sample(hw: tuple[int, int] = (12, 16), seed: int = 0) -> Sample:
    rng = np.random.default_rng(seed)
    rgb = rng.integers(0, 256, (*hw, 3), dtype=np.uint8)
    thermal = rng.integers(1, 256, hw, dtype=np.uint8)
    return Sample(rgb, thermal, rng.integers(0, 9, hw, dtype=np.uint8), "00001D")


def mixed(x: float, other: float, factor: float) -> int:
    return int(min(255.0, max(0.0, factor * x + (1 - factor) * other)))


def luma_of(pixel: Any) -> int:
    return int(0.2989 * pixel[0] + 0.587 * pixel[1] + 0.114 * pixel[2])


@pytest.mark.parametrize("factors", [(0.5, 1.5, 1.25), (1.5, 0.5, 0.75), (1.25, 1.5, 1.5)])
def test_colours_by_loops(factors: tuple[float, float, float]) -> None:
    """Brightness, contrast, saturation, each truncated to whole grey levels."""
    image = sample((3, 4)).rgb
    pixels = [[mixed(v, 0, factors[0]) for v in pixel] for pixel in image.reshape(-1, 3).tolist()]
    mean = sum(map(luma_of, pixels)) / len(pixels)
    pixels = [[mixed(v, mean, factors[1]) for v in pixel] for pixel in pixels]
    pixels = [[mixed(v, luma_of(pixel), factors[2]) for v in pixel] for pixel in pixels]
    expected = np.array(pixels).reshape(image.shape)
    np.testing.assert_allclose(recoloured(image, *factors), expected, atol=0)


def test_factors_of_one_change_nothing() -> None:
    image = sample().rgb
    np.testing.assert_array_equal(recoloured(image, 1.0, 1.0, 1.0), image)


def blurred(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """3x3 kernel of deviation 0.8; the image is mirrored at its border pixels."""
    side = np.exp(-1 / (2 * 0.8**2))
    row = np.array([side, 1, side]) / (1 + 2 * side)
    wide = np.pad(image.astype(float), ((1, 1), (1, 1), (0, 0)), mode="reflect")
    height, width = image.shape[:2]
    return sum(  # type: ignore[return-value]
        row[y] * row[x] * wide[y : y + height, x : x + width] for y in range(3) for x in range(3)
    )


def test_rgb_alone_is_blurred_and_recoloured() -> None:
    original, rng = sample(), np.random.default_rng(1)
    for setting in ("blur_probability", "colour_probability"):
        seen = 0
        for _ in range(20):
            example = cmnext(**{setting: 1.0}).train(original, rng)
            inside = example.label != IGNORE
            row, column = example.position.astype(int)  # type: ignore[union-attr]
            np.testing.assert_array_equal(
                example.thermal[inside], original.thermal[row, column][inside]
            )
            rgb = original.rgb[row, column]
            seen += not np.array_equal(example.rgb[inside], rgb[inside])
            if setting == "blur_probability":
                difference = example.rgb - blurred(original.rgb)[row, column]
                assert np.abs(difference[inside]).max() <= 1
        assert seen == 20


def test_a_crop_begins_at_most_one_pixel_too_far() -> None:
    """Of 10 pixels 7 are cut: first 0..4, the last of them with 6 pixels; of 7 or 5: 0 or 1."""
    for length, crop, expected in (
        (10, 7, {(0, 7), (1, 7), (2, 7), (3, 7), (4, 6)}),
        (7, 7, {(0, 7), (1, 6)}),
        (5, 7, {(0, 5), (1, 4)}),
        (1, 7, {(0, 1)}),
    ):
        rng = np.random.default_rng(2)
        assert {draw_offset(length, crop, rng) for _ in range(200)} == expected


def test_padding_is_black_below_and_on_the_right() -> None:
    for seed in range(20):
        example = cmnext(scale_range=(0.5, 0.5)).train(sample(), np.random.default_rng(seed))
        inside = example.label != IGNORE
        rows, columns = inside.any(1), inside.any(0)
        height, width = int(rows.sum()), int(columns.sum())
        assert (height, width) in {(6, 8), (6, 7), (5, 8), (5, 7)}
        assert inside[:height, :width].all()
        assert not example.rgb[~inside].any()
        assert not example.thermal[~inside].any()


def test_crops_of_a_mirrored_image_lie_where_the_release_cuts_them() -> None:
    """All pixels of a crop are those of the mirrored image from the drawn corner on."""
    original = sample((14, 20))
    mirrored = original.label[:, ::-1]
    corners = set()
    for seed in range(300):
        example = cmnext(flip_probability=1.0).train(original, np.random.default_rng(seed))
        inside = example.label != IGNORE
        height, width = int(inside.any(1).sum()), int(inside.any(0).sum())
        part = example.label[:height, :width]
        places = [
            (top, left)
            for top in range(14 - height + 1)
            for left in range(20 - width + 1)
            if np.array_equal(mirrored[top : top + height, left : left + width], part)
        ]
        assert len(places) == 1
        corners.add((*places[0], height, width))
    expected = {(t, x, 12 - (t == 3), 16 - (x == 5)) for t in range(4) for x in range(6)}
    assert corners == expected


def test_odds_are_those_of_the_settings() -> None:
    transform = cmnext(
        colour_probability=0.2, flip_probability=0.5, blur_probability=0.2, scale_range=(0.5, 2.0)
    )
    original, rng, heights, flips = sample((24, 32)), np.random.default_rng(3), [], 0
    for _ in range(600):
        example = transform.train(original, rng)
        position = example.position
        assert position is not None
        flips += position[1, 0, 0] > position[1, 0, 1] or position[1, 0, 0] > position[1, 0, 3]
        heights.append(example.label.shape)
    assert abs(flips - 300) < 60
    assert set(heights) == {(12, 16)}
    grey = Sample(np.full((4, 4, 3), 100, np.uint8), original.thermal[:4, :4], None, "")
    changed = sum(bool((transform.train(grey, rng).rgb[0, 0] != 100).any()) for _ in range(600))
    assert abs(changed - 120) < 40  # a blur leaves a grey image as it is
