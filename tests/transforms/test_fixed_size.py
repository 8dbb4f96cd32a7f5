"""Draws, padding and blur of the transforms of fixed size; their steps are in `test_releases`."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.transforms.fixed_size import draw_ends, draw_offset, draw_span, recoloured
from rgbt.types import IGNORE
from tests.transforms.recipes import crm, noise
from tests.transforms.test_releases import made


@pytest.mark.parametrize(
    ("draw", "expected"),
    [
        (lambda rng: draw_span(4, 4, rng), {(0, 4)}),
        (lambda rng: draw_span(3, 4, rng), {(0, 3)}),
        # 0..3, and the last one lacks a pixel.
        (lambda rng: draw_span(6, 4, rng), {(0, 4), (1, 4), (2, 4), (3, 3)}),
        (lambda rng: draw_offset(10, 7, rng), {(0, 7), (1, 7), (2, 7), (3, 7), (4, 6)}),
        (lambda rng: draw_offset(7, 7, rng), {(0, 7), (1, 6)}),
        (lambda rng: draw_offset(5, 7, rng), {(0, 5), (1, 4)}),
        (lambda rng: draw_offset(1, 7, rng), {(0, 1)}),
        (lambda rng: draw_ends(9, 0.1, rng), {(0, 9)}),
        (lambda rng: draw_ends(640, 0.0, rng), {(0, 640)}),
        (lambda rng: draw_ends(10, 0.1, rng), {(0, 9), (0, 10)}),
        (lambda rng: draw_ends(4, 0.5, rng), {(a, b) for a in (0, 1) for b in (2, 3, 4)}),
        # x1 in [0, 64), x2 in [576, 640] of MFNet
        (lambda rng: draw_ends(640, 0.1, rng)[:1], {(first,) for first in range(64)}),
        (lambda rng: draw_ends(640, 0.1, rng)[1:], {(end,) for end in range(576, 641)}),
    ],
)
def test_draws_are_uniform_over_those_of_the_release(draw: Any, expected: set[Any]) -> None:
    rng, number = np.random.default_rng(1), 60 * len(expected)
    counts = Counter(draw(rng) for _ in range(number))
    assert set(counts) == expected
    assert max(abs(count - 60) for count in counts.values()) < 40  # five standard deviations


def test_mirroring_and_sizes_have_their_odds() -> None:
    rng, original = np.random.default_rng(6), noise()
    cmx = replace(made("cmx_released"), factors=(0.25, 0.5))
    shapes: Counter[Any] = Counter()
    mirrored = 0
    for _ in range(600):
        example = cmx.train(original, rng)
        shapes[int((example.rgb[..., 0] != example.rgb[0, 0, 0]).any(1).sum())] += 1
        mirrored += example.position[1, 20, 20] > example.position[1, 20, 40]
    assert abs(mirrored - 300) < 62
    assert sorted(shapes) == [12, 24]
    assert abs(shapes[12] - 300) < 62
    sizes = Counter(
        crm(sizes=(24, 48, 96), crop_hw=None, max_size=100).train(original, rng).label.shape
        for _ in range(300)
    )
    assert set(sizes) == {(24, 32), (48, 64), (75, 100)}
    assert min(sizes.values()) > 60


def test_padding_follows_the_order_of_the_means() -> None:
    for order, expected in (("rgb", [124, 116, 104]), ("bgr", [104, 116, 124])):
        words = (f"transform.padding_order={order}", "transform.factors=[0.5]")
        config = ("transform.padding_rgb=[123.675,116.28,103.53]",)
        example = made("cmx_released", *words, *config).train(noise(), np.random.default_rng(7))
        assert example.rgb[0, 0].tolist() == expected
        assert (example.label[0] == IGNORE).all()


@pytest.mark.parametrize("inputs", ["cmx", "cmx_released", "temporal", "crm", "unit"])
def test_padding_is_zero_for_the_network(inputs: str) -> None:
    """To half a grey level; thermal on the mean of its channels."""
    config = compose(["model=cmx_tiny", f"model/inputs={inputs}", "transform=cmx_released"])
    transform, normalise = build(config.transform), build(config.model.inputs)
    transform = replace(transform, factors=(0.5,))
    bare = noise(hw=(120, 160), label=np.zeros((120, 160), np.uint8))
    example = transform.train(bare, np.random.default_rng(8))
    outside = torch.from_numpy(example.label == IGNORE)
    rgb = torch.from_numpy(example.rgb).permute(2, 0, 1)[None] / 255
    images = normalise(rgb, torch.from_numpy(example.thermal)[None, None] / 255)
    half_level = (0.5 / 255) / min(normalise.rgb_std.min(), normalise.thermal_std.min())
    assert outside.float().mean() == 0.75
    assert images.rgb[0][:, outside].abs().max() <= half_level * 1.001
    grey_levels = images.thermal[0][:, outside] * normalise.thermal_std.view(-1, 1) * 255
    assert grey_levels.mean(0).abs().max() <= 0.501


def test_recoloured_by_hand() -> None:
    """(100, 50, 20): half as bright (50, 25, 10), luma 30; contrast 2 about 30: (70, 20, 0)."""
    image = np.full((2, 2, 3), (100, 50, 20), np.uint8)
    assert recoloured(image, 0.5, 1.0, 1.0)[0, 0].tolist() == [50, 25, 10]
    assert recoloured(image, 0.5, 2.0, 1.0)[0, 0].tolist() == [70, 20, 0]
    # Luma of (70, 20, 0) is 32: half the saturation is half way to it.
    assert recoloured(image, 0.5, 2.0, 0.5)[0, 0].tolist() == [51, 26, 16]
    np.testing.assert_array_equal(recoloured(image, 1.0, 1.0, 1.0), image)


def test_thesis_blurs_rgb_and_thermal_alone() -> None:
    """Binomial weights of five pixels along both axes, borders mirrored at the last pixel."""

    def gaussian(image: np.ndarray) -> np.ndarray:
        weights = np.array([1, 4, 6, 4, 1]) / 16
        sides = ((2, 2), (2, 2), *((0, 0),) * (image.ndim - 2))
        padded = np.pad(image.astype(float), sides, "reflect")
        height, width = image.shape[:2]
        rows = sum(w * padded[i : i + height] for i, w in enumerate(weights))
        return np.asarray(sum(w * rows[:, i : i + width] for i, w in enumerate(weights)))

    sharp, soft = (
        made("thesis", f"transform.blur_probability={p}").train(noise(), np.random.default_rng(6))
        for p in (0.0, 1.0)
    )
    for name in ("rgb", "thermal"):
        assert np.abs(getattr(soft, name) - gaussian(getattr(sharp, name))).max() <= 0.5
    np.testing.assert_array_equal(soft.label, sharp.label)
    np.testing.assert_array_equal(soft.confidence, sharp.confidence)
