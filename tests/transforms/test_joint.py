from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional as F

from rgbt.transforms.joint import View, draw_view, nearest_source, short_edge_hw, whole_view

MFNET_SIZES = range(240, 961, 48)


def random_view(rng: np.random.Generator, source_hw: tuple[int, int], short_edge: int) -> View:
    resized_hw = short_edge_hw(source_hw, short_edge, 1920)
    crop_hw = (int(rng.integers(1, source_hw[0])), int(rng.integers(1, source_hw[1])))
    return draw_view(source_hw, resized_hw, crop_hw, 0.5, rng)


def many_views(source_hw: tuple[int, int], count: int) -> list[View]:
    rng = np.random.default_rng(0)
    shorts = rng.integers(source_hw[0] // 3, 2 * source_hw[0] + 1, count)
    return [random_view(rng, source_hw, int(short_edge)) for short_edge in shorts]


def cut(array: np.ndarray, view: View) -> np.ndarray:
    """The window of a whole resized array, the plain way."""
    (top, left), (height, width) = view.corner_yx, view.window_hw
    window = array[top : top + height, left : left + width]
    return window[:, ::-1] if view.flipped else window


@pytest.mark.parametrize(
    ("source_hw", "short_edge", "max_size", "expected"),
    [
        ((480, 640), 240, 1920, (240, 320)),
        ((480, 640), 960, 1920, (960, 1280)),
        ((640, 480), 240, 1920, (320, 240)),
        ((512, 640), 307, 1920, (307, 384)),  # 640 * 307 / 512 = 383.75
        ((720, 1280), 1152, 1920, (1080, 1920)),  # would be 2048 wide
        ((720, 1280), 1152, None, (1152, 2048)),
    ],
)
def test_short_edge_hw(source_hw, short_edge, max_size, expected) -> None:
    assert short_edge_hw(source_hw, short_edge, max_size) == expected


def test_nearest_source_by_hand() -> None:
    assert nearest_source(4, 8).tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert nearest_source(5, 3).tolist() == [0, 1, 3]  # floor(0), floor(1.67), floor(3.33)
    assert nearest_source(3, 3).tolist() == [0, 1, 2]


@pytest.mark.parametrize("source", [97, 480, 512, 640, 720, 1280])
def test_nearest_source_is_that_of_torch(source: int) -> None:
    line = torch.arange(source, dtype=torch.float32)[None, None, :, None]
    for resized in [*MFNET_SIZES, 97, 307, 320, 448, 1080, 1280]:
        expected = F.interpolate(line, size=(resized, 1), mode="nearest").flatten()
        np.testing.assert_array_equal(nearest_source(source, resized), expected.numpy())


@pytest.mark.parametrize("source_hw", [(48, 64), (51, 64), (37, 53), (72, 128)])
def test_window_equals_resizing_everything_and_cropping(source_hw: tuple[int, int]) -> None:
    """Bit for bit in uint8; to float rounding in float32."""
    image = np.random.default_rng(1).integers(0, 256, (*source_hw, 3), dtype=np.uint8)
    for view in many_views(source_hw, 60):
        size = view.resized_hw[::-1]
        whole = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR_EXACT)
        np.testing.assert_array_equal(view.bilinear(image, np.uint8), cut(whole, view))
        whole = cv2.resize(image.astype(np.float32), size, interpolation=cv2.INTER_LINEAR)
        found = view.bilinear(image, np.float32)
        np.testing.assert_allclose(found, cut(whole, view), rtol=0, atol=1e-3)


def test_window_at_the_sizes_of_the_recipe() -> None:
    rng = np.random.default_rng(2)
    image = rng.integers(0, 256, (480, 640), dtype=np.uint8)
    for short_edge in MFNET_SIZES:
        resized_hw = short_edge_hw((480, 640), short_edge, 1920)
        whole = cv2.resize(image, resized_hw[::-1], interpolation=cv2.INTER_LINEAR_EXACT)
        for _ in range(3):
            view = draw_view((480, 640), resized_hw, (240, 320), 0.5, rng)
            np.testing.assert_array_equal(view.bilinear(image, np.uint8), cut(whole, view))


@pytest.mark.parametrize("short_edge", [24, 31, 48, 57, 96])
def test_bilinear_is_that_of_torch(short_edge: int) -> None:
    """Exact against torch in double precision; torch's own float32 coordinates are coarser."""
    image = np.random.default_rng(3).integers(0, 256, (48, 64, 3), dtype=np.uint8)
    resized_hw = short_edge_hw((48, 64), short_edge, None)
    planes = torch.from_numpy(image).permute(2, 0, 1)[None]
    view = whole_view((48, 64), resized_hw)
    found = view.bilinear(image, np.float32)
    for dtype, tolerance in ((torch.float64, 1e-3), (torch.float32, 1e-2)):
        expected = F.interpolate(
            planes.to(dtype), size=resized_hw, mode="bilinear", align_corners=False
        )
        expected = expected[0].permute(1, 2, 0).numpy()
        np.testing.assert_allclose(found, expected, rtol=0, atol=tolerance)
    rounded = view.bilinear(image, np.uint8)
    assert rounded.dtype == np.uint8
    assert np.abs(rounded - found).max() < 1.5


def test_bilinear_by_hand() -> None:
    """Doubling 0, 8: samples at -1/4 (clamped), 1/4, 3/4, 5/4 (clamped)."""
    view = whole_view((1, 2), (1, 4))
    assert view.bilinear(np.array([[0, 8]], np.uint8), np.float32).tolist() == [[0, 2, 6, 8]]


def test_label_comes_from_the_position() -> None:
    label = np.random.default_rng(4).integers(0, 9, (48, 64), dtype=np.uint8)
    for view in many_views((48, 64), 60):
        row, column = view.position().astype(int)
        np.testing.assert_array_equal(view.nearest(label), label[row, column])


def test_label_is_resized_as_torch_does() -> None:
    label = np.random.default_rng(5).integers(0, 9, (48, 64), dtype=np.uint8)
    for view in many_views((48, 64), 30):
        planes = torch.from_numpy(label)[None, None]
        whole = F.interpolate(planes, size=view.resized_hw, mode="nearest")[0, 0].numpy()
        np.testing.assert_array_equal(view.nearest(label), cut(whole, view))


def test_images_and_labels_move_together() -> None:
    """At the original size all three are copies of the same pixels."""
    image = np.random.default_rng(6).integers(0, 256, (48, 64), dtype=np.uint8)
    for flipped in (False, True):
        view = View((48, 64), (48, 64), (5, 7), (20, 30), flipped)
        np.testing.assert_array_equal(view.bilinear(image, np.uint8), view.nearest(image))
        np.testing.assert_array_equal(view.nearest(image), cut(image, view))


def test_centre_is_the_argmin_of_the_distance() -> None:
    """The definition, over all pixels, against the separable computation."""
    for view in many_views((48, 64), 80) + many_views((37, 53), 40):
        centre = np.array([view.source_hw[0] // 2, view.source_hw[1] // 2])
        distance = np.linalg.norm(view.position() - centre[:, None, None], axis=0)
        expected = np.unravel_index(distance.argmin(), distance.shape)
        assert view.centre_yx() == tuple(map(int, expected))


def test_centre_outside_the_crop_lies_on_its_border() -> None:
    assert View((48, 64), (48, 64), (0, 0), (10, 10)).centre_yx() == (9, 9)
    assert View((48, 64), (48, 64), (38, 54), (10, 10)).centre_yx() == (0, 0)
    assert View((48, 64), (48, 64), (38, 54), (10, 10), flipped=True).centre_yx() == (0, 9)
    assert whole_view((48, 64), (96, 128)).centre_yx() == (48, 64)


def test_crops_are_uniform_and_clipped() -> None:
    rng = np.random.default_rng(7)
    views = [draw_view((4, 6), (4, 6), (3, 4), 0.5, rng) for _ in range(3000)]
    corners, counts = np.unique([view.corner_yx for view in views], axis=0, return_counts=True)
    assert corners.tolist() == [[y, x] for y in range(2) for x in range(3)]
    assert abs(counts - 500).max() < 100  # five standard deviations
    assert abs(sum(view.flipped for view in views) - 1500) < 140
    clipped = draw_view((4, 6), (4, 6), (100, 5), 0.0, rng)
    assert clipped.window_hw == (4, 5)
    assert not clipped.flipped
