"""Warps against slow ones, OpenCV, and themselves: exact shifts, borders, gradients, half sizes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from rgbt.geometry.camera import homography, inner_rectangle
from rgbt.geometry.warp import (
    Resampling,
    Warp,
    halved_all,
    halved_label,
    halved_mean,
    normalised,
    powers_of_two,
)
from tests.geometry.views import HW, RELEASED, random_angles, random_views

RESAMPLINGS: tuple[Resampling, ...] = ("once", "twice")


def whole(hw: tuple[int, int], batch: int = 1) -> Tensor:
    edges = [-0.5, -0.5, hw[1] - 0.5, hw[0] - 0.5]
    return torch.tensor([edges], dtype=torch.float64).expand(batch, -1)


def shift(x: float, y: float) -> Tensor:
    return torch.tensor([[[1, 0, x], [0, 1, y], [0, 0, 1]]], dtype=torch.float64)


def random_values(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
    return torch.randn(shape, dtype=dtype, generator=torch.Generator().manual_seed(0))


def small_warp(resampling: Resampling) -> Warp:
    """Two views of 10 x 12 pixels: turned and cut to the corners, and shifted half out."""
    hw = (10, 12)
    matrix = torch.tensor([[13.0, 0, 6], [0, 13, 5], [0, 0, 1]])
    turned = homography(torch.tensor([[6.0, -8.0, 10.0]]), matrix, "zyx")
    rectangles = torch.cat([inner_rectangle(turned, hw, "corners"), whole(hw)])
    return Warp(torch.cat([turned, shift(4.3, -2.6)]), rectangles, hw, resampling)


def mixed(image: np.ndarray[Any, Any], x: float, y: float, *, repeat: bool) -> Any:
    """Bilinear value of (C, H, W) at a point, pixel by pixel; zeros or repeated borders."""
    height, width = image.shape[1:]
    if repeat:
        if not (-0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5):
            return np.zeros(len(image))
        x, y = min(max(x, 0), width - 1), min(max(y, 0), height - 1)
    total = np.zeros(len(image))
    for row in range(int(np.floor(y)), int(np.floor(y)) + 2):
        for column in range(int(np.floor(x)), int(np.floor(x)) + 2):
            if 0 <= row < height and 0 <= column < width:
                total += (1 - abs(x - column)) * (1 - abs(y - row)) * image[:, row, column]
    return total


def slow(warp: Warp, image: Tensor) -> Tensor:
    """`Warp.bilinear` of one composed or two separate passes, as loops over pixels."""
    out = []
    for values, h, rectangle in zip(image.numpy(), warp.homography, warp.rectangle, strict=True):
        back, (height, width) = np.linalg.inv(h.numpy()), warp.image_hw
        left, top, right, bottom = rectangle.tolist()
        xs = left + (np.arange(width) + 0.5) * (right - left) / width
        ys = top + (np.arange(height) + 0.5) * (bottom - top) / height
        source, repeat = values, warp.resampling == "once"
        if not repeat:
            source = np.empty_like(values)
            for i, j in np.ndindex(height, width):
                x, y, w = back @ [j, i, 1]
                source[:, i, j] = mixed(values, x / w, y / w, repeat=False)
        result = np.empty_like(values)
        for i, j in np.ndindex(height, width):
            x, y, w = back @ [xs[j], ys[i], 1] if repeat else (xs[j], ys[i], 1.0)
            if not repeat:  # a cut picture is resized on its own: its border pixels repeat
                x, y = np.clip(x, left + 0.5, right - 0.5), np.clip(y, top + 0.5, bottom - 0.5)
            result[:, i, j] = mixed(source, x / w, y / w, repeat=repeat)
        out.append(result)
    return torch.from_numpy(np.stack(out))


@pytest.mark.parametrize("resampling", RESAMPLINGS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("x", "y", "hw"),
    [(0, 0, (1, 3)), (0, 0, (64, 48)), (5, -3, HW), (-1, 0, HW), (0, 16, (17, 23)), (-13, 2, HW)],
)
def test_whole_shifts_move_pixels_unchanged(
    x: int, y: int, hw: tuple[int, int], dtype: torch.dtype, resampling: Resampling
) -> None:
    values = random_values(1, 2, *hw, dtype=dtype)
    warp = Warp(shift(x, y), whole(hw), hw, resampling)
    inside = torch.zeros(hw, dtype=torch.bool)
    inside[max(y, 0) : hw[0] + min(y, 0), max(x, 0) : hw[1] + min(x, 0)] = True
    moved = values.roll((y, x), (2, 3))
    assert torch.equal(warp.bilinear(values), torch.where(inside, moved, 0.0).to(dtype))
    assert torch.equal(warp.nearest(values, 9.0), torch.where(inside, moved, 9.0).to(dtype))
    assert torch.equal(warp.inside()[0], inside)


@pytest.mark.parametrize("resampling", RESAMPLINGS)
def test_bilinear_is_the_slow_one_and_has_its_gradient(resampling: Resampling) -> None:
    warp, values = small_warp(resampling), random_values(2, 3, 10, 12, dtype=torch.float64)
    torch.testing.assert_close(warp.bilinear(values), slow(warp, values), atol=1e-5, rtol=0)
    assert torch.autograd.gradcheck(warp.bilinear, (values[:, :2].clone().requires_grad_(),))


@pytest.mark.parametrize(("x", "y"), [(0.5, 0), (-0.5, 0), (0, 0.5), (0, -0.5)])
def test_once_repeats_the_border_and_twice_fades_it_out(x: float, y: float) -> None:
    """At each side: the outline itself, half a pixel from the first centre, is 0.5 with zeros."""
    ones, moved = torch.ones(1, 1, 4, 6), shift(x, y)
    once, twice = (Warp(moved, whole((4, 6)), (4, 6), resampling) for resampling in RESAMPLINGS)
    assert torch.equal(once.bilinear(ones), ones)
    faded = ones[0, 0].clone()
    lines = faded if y else faded.T
    lines[0 if x + y > 0 else -1] = 0.5
    assert torch.equal(twice.bilinear(ones)[0, 0], faded)


def test_normalised_edges_and_centres_by_hand() -> None:
    """11 x 13 is padded to 16 x 16: pixel 0 has its centre at 1/16 - 1, its edge at -1."""
    assert powers_of_two((11, 13)) == (16, 16)
    x, y = torch.tensor([[[-0.5, 0.0, 12.0]]]), torch.tensor([[[15.5, 7.5, 0.5]]])
    expected = [[-1.0, 1.0], [-15 / 16, 0.0], [9 / 16, -14 / 16]]
    assert normalised(x, y, (11, 13))[0, 0].tolist() == expected


@pytest.mark.parametrize("dtype", [torch.uint8, torch.int64, torch.float64, torch.bool])
def test_nearest_takes_any_dtype_with_and_without_channels(dtype: torch.dtype) -> None:
    warp = small_warp("once")
    values = (random_values(2, 3, 10, 12) > 0).to(dtype)
    warped = warp.nearest(values, 1)
    assert (warped.dtype, warped.shape) == (dtype, values.shape)
    assert torch.equal(warp.nearest(values[:, 1], 1), warped[:, 1])
    with pytest.raises(ValueError, match="values: expected shape"):
        warp.nearest(values[..., 1:], 1)


@pytest.mark.parametrize("resampling", RESAMPLINGS)
def test_views_without_a_rectangle_and_from_behind_show_nothing(resampling: Resampling) -> None:
    behind = homography(torch.tensor([[180.0, 0.0, 0.0]]), RELEASED.matrix((48, 64)), "zyx")
    for view, edges in ((shift(0, 0), torch.nan * whole((48, 64))), (behind, whole((48, 64)))):
        warp = Warp(view, edges, (48, 64), resampling)
        assert not bool(warp.inside().any())
        assert warp.bilinear(torch.ones(1, 1, 48, 64)).abs().sum() == 0
        assert warp.nearest(torch.zeros(1, 48, 64), 255).unique().tolist() == [255]


def test_resized_warp_is_warp_by_the_resized_camera() -> None:
    angles, small = random_angles(3, 2), (240, 320)
    views = homography(angles, RELEASED.matrix(HW), "zyx")
    warp = Warp(views, inner_rectangle(views, HW, "largest"), HW, "once")
    half = homography(angles, RELEASED.matrix(small), "zyx")
    resized = warp.resized(small)
    torch.testing.assert_close(resized.homography, half)
    torch.testing.assert_close(resized.rectangle, inner_rectangle(half, small, "largest"))
    assert resized.image_hw == small


def test_a_warp_of_another_aspect_by_hand() -> None:
    """Twice the columns, half of the rows: an edge e becomes (e + 0.5) s - 0.5, a shift s times."""
    cut = torch.tensor([[2.5, 0.5, 7.5, 6.5]], dtype=torch.float64)
    found = Warp(shift(4.5, -2), cut, (10, 12), "once").resized((5, 24))
    assert found.rectangle.tolist() == [[5.5, 0.0, 15.5, 3.0]]
    torch.testing.assert_close(found.homography, shift(9, -1))


def test_nearest_between_two_pixels_takes_the_second() -> None:
    """x = -0.5, 0.5, ...: in each pair of pixels the right one, and the lower one."""
    label = torch.arange(24).view(1, 4, 6)
    for x, y in ((0.5, 0), (0, 0.5)):
        warp = Warp(shift(x, y), whole((4, 6)), (4, 6), "once")
        assert torch.equal(warp.nearest(label, 255), label)


def test_a_resized_cut_may_begin_within_a_pixel() -> None:
    """Columns 3..7 and rows 1..6 of 8, cut twice: at half the size they begin at 1.5 and 0.5."""
    cut = torch.tensor([[2.5, 0.5, 7.5, 6.5]], dtype=torch.float64)
    warp = Warp(shift(0, 0), cut, (8, 8), "twice").resized((4, 4))
    label = torch.arange(16).view(1, 4, 4)
    # floor(1.5 + 0.625 i) and floor(0.5 + 0.75 i)
    columns, rows = torch.tensor([1, 2, 2, 3]), torch.tensor([0, 1, 2, 2])
    assert torch.equal(warp.nearest(label, 255)[0], 4 * rows[:, None] + columns)


def test_levels_are_rounded_after_each_interpolation() -> None:
    cut = torch.tensor([[2.5, 1.5, 8.5, 7.5]], dtype=torch.float64)
    values = random_values(1, 2, 10, 12).sigmoid()
    canvas = Warp(shift(0.3, -0.4), whole((10, 12)), (10, 12), "twice")
    resize = Warp(shift(0, 0), cut, (10, 12), "twice")
    both = Warp(shift(0.3, -0.4), cut, (10, 12), "twice")
    stepwise = (255 * canvas.bilinear(values)).round() / 255
    stepwise = (255 * resize.bilinear(stepwise)).round()
    rounded = both.bilinear(values, levels=255)
    torch.testing.assert_close(255 * rounded, stepwise, atol=1e-3, rtol=0)
    at_the_end = (255 * both.bilinear(values)).round()
    assert float((255 * rounded - at_the_end).abs().max()) > 0.5


# ---- half sizes -----------------------------------------------------------------------------


@pytest.mark.parametrize("hw", [(4, 6), (5, 6), (4, 7), (5, 7), (1, 1)])
def test_half_pixels_cover_what_exists_of_two_by_two(hw: tuple[int, int]) -> None:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 3, *hw, generator=generator)
    mask = torch.rand(2, *hw, generator=generator) < 0.8
    label = torch.randint(2, (2, *hw), generator=generator)
    label[0, 0, 0] = 255
    mean, all_of, agreed = halved_mean(values), halved_all(mask), halved_label(label)
    half_hw = (-(-hw[0] // 2), -(-hw[1] // 2))
    assert mean.shape == (2, 3, *half_hw)
    assert all_of.shape == agreed.shape == (2, *half_hw)
    for row, column in np.ndindex(half_hw):
        part = (..., slice(2 * row, 2 * row + 2), slice(2 * column, 2 * column + 2))
        torch.testing.assert_close(mean[..., row, column], values[part].mean((-2, -1)))
        assert torch.equal(all_of[:, row, column], mask[part].flatten(1).all(-1))
        classes = label[part].flatten(1)
        same = (classes == classes[:, :1]).all(-1)
        assert torch.equal(agreed[:, row, column], classes[:, 0].where(same, 255))
    exact = random_values(2, 3, *hw, dtype=torch.float64)
    for values in (exact, exact.to(memory_format=torch.channels_last)):
        assert torch.autograd.gradcheck(halved_mean, (values.clone().requires_grad_(),))


@pytest.mark.parametrize("hw", [HW, (45, 60), (44, 61), (45, 61)])
@pytest.mark.parametrize("resampling", RESAMPLINGS)
def test_a_halved_warp_shows_the_same_points(hw: tuple[int, int], resampling: Resampling) -> None:
    """Maps of columns and rows: an error of the pixel centres would be at least 0.25 pixels."""
    views = random_views(3, 4)
    warp = Warp(views, inner_rectangle(views, HW, "largest"), HW, resampling).resized(hw)
    half = warp.halved()
    assert half.image_hw == (-(-hw[0] // 2), -(-hw[1] // 2))
    places = torch.stack(torch.meshgrid(*(torch.arange(n).float() for n in hw), indexing="ij"))
    places = places.expand(3, -1, -1, -1)
    expected = halved_mean(warp.bilinear(places))
    found = half.bilinear(halved_mean(places))
    last = torch.tensor(hw).view(1, 2, 1, 1) - 1
    # Values are repeated, or fade out, at the borders of both frames.
    away = ((expected > 3) & (expected < last - 3)).all(1, keepdim=True)
    away[..., :2, :] = away[..., -2:, :] = away[..., :2] = away[..., -2:] = False
    assert float(away.float().mean()) > 0.6
    assert float((found - expected).abs().where(away, 0).max()) < 0.05
