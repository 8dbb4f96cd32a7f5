"""The homography of a rig from pairs, against warps that the test applies."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from rgbt.config.overrides import built
from rgbt.geometry.alignment import (
    Alignment,
    edges,
    estimated,
    grid_of,
    moved,
    resizing,
    root_mean_square,
)
from rgbt.geometry.optical_flow import gray_of
from tests.geometry.warps import Image, drawn_warp, inner, mean_error, warped

HW = (120, 160)


def scene(number: int) -> NDArray[np.uint8]:
    """Rectangles of random brightness, as seen by RGB."""
    rng = np.random.default_rng(number)
    image = np.full(HW, 128, np.uint8)
    for _ in range(60):
        x, y, width, height = (int(v) for v in rng.integers((-10, -10, 8, 8), (150, 110, 40, 40)))
        image[max(y, 0) : y + height, max(x, 0) : x + width] = rng.integers(256)
    return image


def thermal_of(image: NDArray[np.uint8], number: int) -> NDArray[np.uint8]:
    """The same edges, other brightness: grey levels are permuted, so that signs differ."""
    table = np.random.default_rng(1000 + number).permutation(256).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(table[image], (0, 0), 0.7), np.uint8)


@pytest.fixture(scope="module")
def pairs() -> list[tuple[Image, Image]]:
    images = [scene(number) for number in range(6)]
    return [(image, thermal_of(image, number)) for number, image in enumerate(images)]


def test_known_warp_is_found(pairs: list[tuple[Image, Image]]) -> None:
    warp = drawn_warp(np.random.default_rng(3), pairs[0][0])
    found = estimated([(inner(rgb), warped(thermal, warp)) for rgb, thermal in pairs])
    assert found is not None
    assert found.reason(HW) == ""
    assert mean_error(np.eye(3), warp, pairs[0][0]) > 2  # what is to be found
    assert mean_error(found.matrix, warp, pairs[0][0]) < 0.25
    assert found.outliers == ()


def test_uncertainty_is_of_the_size_of_the_error(pairs: list[tuple[Image, Image]]) -> None:
    rng, errors, stated = np.random.default_rng(5), [], []
    for pair in pairs:
        warp = drawn_warp(rng, pair[0])
        found = estimated([(inner(pair[0]), warped(pair[1], warp))])
        assert found is not None
        errors.append(mean_error(found.matrix, warp, pair[0]))
        stated.append(root_mean_square(found.uncertainty))
    assert 1 / 4 < np.mean(stated) / np.mean(errors) < 4


def test_thermal_of_another_size(pairs: list[tuple[Image, Image]]) -> None:
    """Half as many pixels: the middles of pixels follow x' = (x + 0.5) / 2 - 0.5."""
    half = (HW[1] // 2, HW[0] // 2)
    small = [
        (rgb, cv2.resize(thermal, half, interpolation=cv2.INTER_AREA)) for rgb, thermal in pairs
    ]
    found = estimated([(rgb, np.asarray(thermal)) for rgb, thermal in small])
    assert found is not None
    by_hand = (grid_of(HW) + 0.5) / 2 - 0.5
    assert np.linalg.norm(moved(found.matrix, grid_of(HW)) - by_hand, axis=1).mean() < 0.25
    assert np.median(found.residuals) < 0.5
    # Points are of RGB, partners of thermal.
    assert np.abs(found.points / 2 - found.partners).max() < 3


def test_pair_of_another_moment_is_an_outlier(pairs: list[tuple[Image, Image]]) -> None:
    late = (pairs[0][0], np.asarray(np.roll(pairs[0][1], (3, 3), (0, 1))))
    found = estimated([late, *pairs[1:]])
    assert found is not None
    assert found.outliers == (0,)
    assert mean_error(found.matrix, np.eye(3), pairs[0][0]) < 0.25
    assert int(np.argmin(found.scores)) == 0


def noise(_: Image, rng: np.random.Generator) -> Image:
    return rng.integers(0, 256, HW).astype(np.uint8)


def flat(image: Image, _: np.random.Generator) -> Image:
    return np.full_like(image, 7)


@pytest.mark.parametrize("thermal", [noise, flat])
def test_without_common_edges_nothing_is_estimated(
    pairs: list[tuple[Image, Image]], thermal: Any
) -> None:
    rng = np.random.default_rng(0)
    found = estimated([(rgb, thermal(rgb, rng)) for rgb, _ in pairs[:3]])
    assert found is None or found.reason(HW)


def test_reason_names_what_is_wrong() -> None:
    points, sure = np.zeros((1, 2)), np.full((21, 21), 0.1)
    assert Alignment(np.eye(3), points, points, sure).reason((480, 640)) == ""
    few = Alignment(np.eye(3), points, points, sure, share=0.5).reason((480, 640))
    assert few.startswith("only 50% of the tiles agree")
    # 2 px of the diagonal 800 is the limit.
    assert Alignment(np.eye(3), points, points, sure * 19.9).reason((480, 640)) == ""
    unsure = Alignment(np.eye(3), points, points, sure * 20.1).reason((480, 640))
    assert unsure.startswith("its uncertainty is 2.0 px")


def test_edges_have_a_direction_without_a_sign() -> None:
    step = np.zeros((20, 20), np.uint8)
    step[:, 10:] = 200
    assert np.allclose(edges(step), edges(200 - step), atol=1e-4)
    # A vertical edge has cos 2a = 1, a horizontal one cos 2a = -1, and sin 2a = 0.
    assert edges(step)[10, 10, 0] > 0.5
    assert np.allclose(edges(step.T)[..., 0], -edges(step)[..., 0].T, atol=1e-4)
    assert np.abs(edges(step)[..., 1]).max() < 1e-4
    diagonal = np.triu(np.full((20, 20), 200, np.uint8))
    assert np.abs(edges(diagonal)[10, 10, 1]) > 5 * np.abs(edges(diagonal)[10, 10, 0])


def test_resizing_keeps_pixel_edges() -> None:
    ends = np.array([[-0.5, -0.5], [159.5, 119.5]])
    assert np.allclose(moved(resizing(HW, (60, 40)), ends), [[-0.5, -0.5], [39.5, 59.5]])


@pytest.mark.slow
@pytest.mark.parametrize(("time", "least"), [("D", 9), ("N", 4)])
def test_embedded_scenes(time: str, least: int) -> None:
    """Of ten scenes each alone, so many are within 0.5 pixels; no wrong one by more than 1."""
    dataset = built("dataset", ["dataset=synth", "dataset.num_test=60"])
    names = [name for name in dataset.names("test") if name.endswith(time)][:10]
    rng, errors = np.random.default_rng(62), []
    samples = [dataset.pair(name) for name in names]
    images = [(gray_of(sample.rgb), sample.thermal) for sample in samples]
    for rgb, thermal in images:
        warp = drawn_warp(rng, rgb)
        found = estimated([(inner(rgb), warped(thermal, warp))])
        if found is not None and not found.reason(inner(rgb).shape):
            errors.append(mean_error(found.matrix, warp, rgb))
    assert sum(error < 0.5 for error in errors) >= least
    assert max(errors) < 1
    warp = drawn_warp(rng, images[0][0])
    rig = estimated([(inner(rgb), warped(thermal, warp)) for rgb, thermal in images])
    assert rig is not None
    assert mean_error(rig.matrix, warp, images[0][0]) < 0.5
