"""Estimated flow between images that are moved by known offsets."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.geometry.optical_flow import FrameFlow, disagreement, estimate, frame_flow
from rgbt.randomness import numpy_generator

HW = (64, 96)
MOVED = (3, -5)
"""Rows and columns by which the scene moves from the first to the second frame."""


def frames() -> tuple[np.ndarray, np.ndarray]:
    """Two parts of smooth noise."""
    noise = numpy_generator(0, "texture").integers(0, 256, (HW[0] + 40, HW[1] + 40))
    scene = cv2.GaussianBlur(noise.astype(np.float32), (0, 0), 2.0)
    scene = (255 * (scene - scene.min()) / np.ptp(scene)).astype(np.uint8)
    (rows, columns), (height, width) = MOVED, HW
    first = scene[20 : 20 + height, 20 : 20 + width]
    second = scene[20 - rows : 20 - rows + height, 20 - columns : 20 - columns + width]
    return np.ascontiguousarray(first), np.ascontiguousarray(second)


def test_flow_leads_to_first_frame_and_drops_pixels_outside() -> None:
    first, second = frames()
    flow = estimate(second, first)
    assert flow.shape == (*HW, 2)
    # A point at row r of the second frame was at r - 3 in the first one.
    np.testing.assert_allclose(np.median(flow[10:-10, 10:-10], axis=(0, 1)), (-3, 5), atol=0.1)
    found = frame_flow({"rgb": first}, {"rgb": second}, "rgb")
    assert found.used[10:-10, 10:-10].mean() > 0.95
    rows, columns = found.source()
    assert (rows[~found.used] == -1).all()
    assert (columns[~found.used] == -1).all()
    used = found.used[20:40, 20:60]
    grid = np.indices(HW)[:, 20:40, 20:60]
    exact = (rows[20:40, 20:60] == grid[0] - 3) & (columns[20:40, 20:60] == grid[1] + 5)
    assert exact[used].mean() > 0.95
    # The three lowest rows of the first frame are below the second one, and the five columns at
    # the right of the second frame were outside.
    assert not found.used[:, -3:].any()
    assert not found.used[:2].any()


def test_the_better_image_is_chosen_at_each_pixel() -> None:
    first, second = frames()
    noise = numpy_generator(1, "noise")
    dark = [noise.integers(0, 2, HW).astype(np.uint8) for _ in range(2)]
    images = ({"rgb": dark[0], "thermal": first}, {"rgb": dark[1], "thermal": second})
    thermal, both, rgb = (frame_flow(*images, kind) for kind in ("thermal", "both", "rgb"))
    assert rgb.used.mean() < 0.5 < 0.8 < thermal.used.mean() <= both.used.mean()
    np.testing.assert_allclose(np.median(both.flow[10:-10, 10:-10], axis=(0, 1)), (-3, 5), atol=0.1)


def test_disagreement_by_hand() -> None:
    flow = np.zeros((4, 6, 2), np.float32)
    flow[..., 1] = 2  # two columns to the right, which leads out of the last two
    back = np.zeros_like(flow)
    back[..., 1] = -1  # and one back: one column is missed
    error = disagreement(flow, back)
    np.testing.assert_allclose(error[:, :4], 1 / (0.01 * (4 + 1) + 0.5))
    assert np.isinf(error[:, 4:]).all()
    back[..., 1] = -2
    assert (disagreement(flow, back)[:, :4] == 0).all()


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize(("line", "sign"), [(0, -1), (-1, 1)])
def test_points_up_to_half_a_pixel_outside_belong_to_the_border(
    axis: int, line: int, sign: int
) -> None:
    for moved, inside in ((0.4, True), (0.6, False)):
        flow = np.zeros((4, 6, 2), np.float32)
        flow[..., axis] = sign * moved
        error = np.isfinite(disagreement(flow, -flow)).swapaxes(0, axis)
        assert (error[line] == inside).all()
        assert np.delete(error, line, 0).all()


def test_source_by_hand() -> None:
    flow = np.array([[[0.4, 1.0], [1.0, -1.2]]], np.float32).repeat(2, 0)
    used = np.array([[True, True], [True, False]])
    rows, columns = FrameFlow(flow, used).source()
    assert rows.tolist() == [[0, 1], [1, -1]]
    assert columns.tolist() == [[1, 0], [1, -1]]


def test_other_sizes_are_refused() -> None:
    for hw in ((8, 96), (64, 90)):
        with pytest.raises(InputError, match="flow: expected one size"):
            estimate(np.zeros(hw, np.uint8), frames()[0])
