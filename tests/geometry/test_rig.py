"""Points of a calibrated rig, by hand; maps and images."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from rgbt.checks import InputError
from rgbt.geometry.rig import maps_of, of_calibration, of_homography, resampled

# Thermal is 0.1 m to the right, has half the focal length, and the plane is 5 m away.
CALIBRATION: dict[str, Any] = {
    "K_rgb": [[500, 0, 320], [0, 500, 240], [0, 0, 1]],
    "D_rgb": [0, 0, 0, 0],
    "K_thermal": [[250, 0, 160], [0, 250, 120], [0, 0, 1]],
    "D_thermal": [0, 0, 0, 0, 0],
    "R": np.eye(3),
    "t": [-0.1, 0, 0],
    "distance": 5.0,
}


def test_points_in_the_plane() -> None:
    """x = 250 (5 (420 - 320) / 500 - 0.1) / 5 + 160 = 205; y = 250 (340 - 240) / 500 + 120."""
    to_thermal, to_rgb = of_calibration(CALIBRATION)
    assert np.allclose(to_thermal(np.array([[420.0, 340.0]])), [[205, 170]])
    assert np.allclose(to_rgb(np.array([[205.0, 170.0]])), [[420, 340]])


def test_distorted_and_turned_cameras_there_and_back() -> None:
    turn = cv2.Rodrigues(np.array([0.02, -0.05, 0.03]))[0]
    lenses = {"D_rgb": [-0.2, 0.05, 0.001, 0, 0], "D_thermal": [0.1, 0, 0, 0.001]}
    to_thermal, to_rgb = of_calibration(
        {**CALIBRATION, **lenses, "R": turn, "t": [-0.1, 0.02, 0.3]}
    )
    points = np.array([[100.0, 80.0], [500.0, 400.0], [320.0, 240.0]])
    assert np.allclose(to_rgb(to_thermal(points)), points, atol=0.05)
    # The point of the principal ray lies at (0, 0, 5): R X + t, projected by hand.
    x, y, z = turn @ [0, 0, 5] + np.array([-0.1, 0.02, 0.3])
    radial = 1 + 0.1 * ((x / z) ** 2 + (y / z) ** 2)
    seen = to_thermal(points[2:])[0]
    tangent = 2 * 0.001 * (x / z) * (y / z)
    assert seen[1] == pytest.approx(250 * (y / z * radial + tangent) + 120, abs=0.01)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"R": [1, 2]}, "'R' has 2 numbers"),
        ({"distance": 0}, "'distance' is not positive"),
        ({"t": [np.nan, 0, 0]}, "'t' has 3 numbers"),
        ({"D_rgb": [0, 0, 0]}, "'D_rgb' has 3 numbers"),
    ],
)
def test_calibrations_that_are_refused(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        of_calibration({**CALIBRATION, **change})
    with pytest.raises(InputError, match="no entry 'K_rgb'"):
        of_calibration({"t": [0, 0, 0]})
    with pytest.raises(InputError, match="inverted"):
        of_homography(np.zeros((3, 3)))


def test_image_is_taken_where_the_maps_lead() -> None:
    """One pixel to the right: the last column has no partner."""
    shift = np.array([[1.0, 0, 1], [0, 1, 0], [0, 0, 1]])
    maps, valid = maps_of(of_homography(shift)[0], (2, 3), (2, 3))
    image = np.array([[1, 2, 3], [4, 5, 6]], np.uint8)
    assert resampled(image, maps).tolist() == [[2, 3, 3], [5, 6, 6]]
    assert valid.tolist() == [[True, True, False]] * 2
    half = np.array([[1.0, 0, 0.5], [0, 1, 0], [0, 0, 1]])
    maps, valid = maps_of(of_homography(half)[0], (2, 3), (2, 3))
    assert valid.all()  # the last column lies on the edge of the last pixel
    assert resampled(image.astype(float), maps).tolist() == [[1.5, 2.5, 3], [4.5, 5.5, 6]]
    colours = np.dstack([image, image + 10, image + 20])
    assert resampled(colours, maps_of(of_homography(shift)[1], (2, 3), (2, 3))[0])[
        0, 1
    ].tolist() == [1, 11, 21]


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_image_of_many_pixels_is_averaged(dtype: Any) -> None:
    """Every third pixel alone would be 90 or 0; the mean of three is 30. A label stays a label."""
    image = np.tile(np.array([[90, 0, 0]], dtype), (6, 4))  # 6 x 12
    third = np.array([[3.0, 0, 1], [0, 3, 1], [0, 0, 1]])  # x' = 3 x + 1
    maps, valid = maps_of(of_homography(third)[0], (2, 4), (6, 12))
    assert valid.all()
    assert resampled(image, maps).tolist() == [[30] * 4] * 2
    shift = third @ np.array([[1, 0, -1 / 3], [0, 1, 0], [0, 0, 1]])  # x' = 3 x
    maps = maps_of(of_homography(shift)[0], (2, 4), (6, 12))[0]
    assert resampled(image, maps, nearest=True).tolist() == [[90] * 4] * 2
