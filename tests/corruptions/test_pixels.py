"""Failures of pixels, each by hand."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from rgbt.corruptions.kinds import (
    DIRECTIONS,
    Blur,
    Corruption,
    Misregistered,
    Noise,
    Occluded,
    Removed,
    moved,
)
from rgbt.randomness import numpy_generator
from rgbt.types import Sample
from tests.corruptions.recorded import sample


def rng_of(seed: int = 0, name: str = "00001D") -> Callable[[str], np.random.Generator]:
    return lambda purpose: numpy_generator(seed, f"{purpose} {name}")


def occluded(image: Any = "thermal", block: int = 32) -> Occluded:
    return Occluded(image=image, block=block, severities=(0.5,))


def flat(rgb: int, thermal: int) -> Sample:
    hw = (120, 160)
    return Sample(np.full((*hw, 3), rgb, np.uint8), np.full(hw, thermal, np.uint8), None, "flat")


MAKE: dict[str, Callable[[Any], Corruption]] = {
    "removed": lambda image: Removed(image=image, severities=(1.0,)),
    "occluded": occluded,
    "noise": lambda image: Noise(image=image, severities=(8.0,)),
    "blur": lambda image: Blur(image=image, severities=(8.0,)),
    "misregistered": lambda _: Misregistered(severities=(8.0,)),
}


@pytest.mark.parametrize("name", MAKE)
def test_the_image_that_is_named_fails_alone(name: str) -> None:
    """Of both at once each fails as it does alone; the source, which is read-only, stays."""
    found, source = {}, sample()
    for image in (source.rgb, source.thermal):  # as of a map of decoded frames
        image.setflags(write=False)
    for image in ("rgb", "thermal", "both"):
        kind = MAKE[name](image)
        found[image] = changed = kind(source, kind.severities[0], rng_of())
        assert (changed.rgb.shape, changed.rgb.dtype) == (source.rgb.shape, np.uint8)
        assert (changed.thermal.shape, changed.thermal.dtype) == (source.thermal.shape, np.uint8)
        assert (changed.label is source.label, changed.name) == (True, source.name)
        same = (
            np.array_equal(changed.rgb, source.rgb),
            np.array_equal(changed.thermal, source.thermal),
        )
        named = image if name != "misregistered" else "thermal"
        assert same == (named == "thermal", named == "rgb")
    if name != "misregistered":
        np.testing.assert_array_equal(found["both"].rgb, found["rgb"].rgb)
    np.testing.assert_array_equal(found["both"].thermal, found["thermal"].thermal)


@pytest.mark.parametrize(
    ("share", "blocks"), [(0.1, 30), (0.25, 75), (0.75, 225), (0.0984, 30), (0.098, 29), (1, 300)]
)
def test_occluded_hides_exactly_that_share_of_whole_blocks(share: float, blocks: int) -> None:
    # 32 pixels of 480 rows are 8 of 120: a grid of 15 x 20 = 300 blocks of 8 x 8 pixels.
    found = occluded("both")(sample(), share, rng_of())
    by_block = (found.thermal == 0).reshape(15, 8, 20, 8).transpose(0, 2, 1, 3).reshape(300, 64)
    assert (by_block.all(1) == by_block.any(1)).all()
    assert by_block.all(1).sum() == blocks
    np.testing.assert_array_equal(found.thermal == 0, (found.rgb == 0).all(2))
    np.testing.assert_array_equal((found.rgb == 0).any(2), (found.rgb == 0).all(2))


def test_a_larger_share_hides_the_same_blocks_and_more() -> None:
    """Also at the edge: 10 x 12 pixels are 3 x 3 blocks, of which those below are 2 rows high."""

    def hidden(block: int, hw: tuple[int, int], share: float) -> np.ndarray:
        return occluded(block=block).hidden(hw, share, np.random.default_rng(3))

    few, many = (hidden(32, (120, 160), share) for share in (0.1, 0.5))
    assert (many | few).sum() == many.sum()
    assert few.sum() == 30 * 64
    assert hidden(192, (10, 12), 1.0).shape == (10, 12)
    assert hidden(192, (10, 12), 1.0).all()
    assert hidden(192, (10, 12), 1 / 9).sum() in (16, 8)


def test_noise_has_its_deviation_and_no_bias() -> None:
    found = Noise(image="both", severities=(16.0,))(flat(128, 128), 16.0, rng_of())
    for image in (found.rgb, found.thermal):
        differences = image.astype(float) - 128
        # 19,200 pixels: the standard error of the deviation is 16 / sqrt(38,400) = 0.08.
        assert differences.std() == pytest.approx(16, abs=0.4)
        assert abs(differences.mean()) < 0.5
    channels = found.rgb.reshape(-1, 3).astype(float).T
    assert abs(np.corrcoef([*channels, found.thermal.ravel()]) - np.eye(4)).max() < 0.03
    # It is cut at black and white, and not wrapped.
    found = Noise(image="both", severities=(20.0,))(flat(0, 255), 20.0, rng_of())
    assert found.rgb.max() < 128 < found.thermal.min()
    assert 0.4 < (found.rgb == 0).mean() < 0.6


def test_blur_of_step_is_normal_distribution_of_its_width() -> None:
    step = np.zeros((120, 160), np.uint8)
    step[:, 80:] = 255
    source = Sample(np.repeat(step[..., None], 3, 2), step, None, "a")
    # 8 pixels of 480 rows are 2 of 120.
    found = Blur(image="thermal", severities=(8.0,))(source, 8.0, rng_of()).thermal
    for column in range(74, 86):
        expected = 255 * 0.5 * (1 + math.erf((column + 0.5 - 80) / 2 / math.sqrt(2)))
        assert found[60, column] == pytest.approx(expected, abs=2)


def test_moved_by_hand() -> None:
    image = np.arange(1, 13, dtype=np.uint8).reshape(3, 4)
    right_and_down = [[1, 1, 2, 3], [1, 1, 2, 3], [5, 5, 6, 7]]
    assert moved(image, 1, 1).tolist() == right_and_down
    assert moved(image, -1, 0).tolist() == [[5, 6, 7, 8], [9, 10, 11, 12], [9, 10, 11, 12]]
    assert moved(image, 0, -2).tolist() == [[3, 4, 4, 4], [7, 8, 8, 8], [11, 12, 12, 12]]


@pytest.mark.parametrize(("severity", "pixels"), [(4, 1), (8, 2), (32, 8), (6, 2), (5, 1)])
def test_misregistered_by_exactly_so_many_pixels_in_one_direction(
    severity: int, pixels: int
) -> None:
    source, drawn = sample(), set()
    for number in range(24):
        found = Misregistered(severities=(4.0,))(source, severity, rng_of(name=str(number)))
        np.testing.assert_array_equal(found.rgb, source.rgb)
        fitting = [
            (down, right)
            for down, right in DIRECTIONS
            if np.array_equal(found.thermal, moved(source.thermal, down * pixels, right * pixels))
        ]
        assert len(fitting) == 1
        drawn.add(fitting[0])
    assert drawn == set(DIRECTIONS)
