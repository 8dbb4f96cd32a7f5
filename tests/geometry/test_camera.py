"""Intrinsics follow the size of the images and refuse those of another picture."""

from __future__ import annotations

import pytest
import torch

from rgbt.checks import InputError
from rgbt.geometry.camera import Camera

SMALL = Camera(fx=100, fy=110, cx=31.5, cy=20, height=48, width=64)


def test_the_matrix_of_its_own_size_holds_the_four_numbers() -> None:
    expected = torch.tensor([[100, 0, 31.5], [0, 110, 20], [0, 0, 1]], dtype=torch.float64)
    assert torch.equal(SMALL.matrix((48, 64)), expected)


def test_half_the_size_halves_focal_lengths_and_moves_the_centre_as_pixel_centres_move() -> None:
    # c' = (c + 0.5) / 2 - 0.5: the middle of an even image stays its middle
    expected = torch.tensor([[50, 0, 15.5], [0, 55, 9.75], [0, 0, 1]], dtype=torch.float64)
    assert torch.equal(SMALL.matrix((24, 32)), expected)


@pytest.mark.parametrize("image_hw", [(480, 600), (64, 48), (49, 64)])
def test_another_aspect_is_another_image_size(image_hw: tuple[int, int]) -> None:
    with pytest.raises(InputError, match="camera: expected images of") as caught:
        SMALL.matrix(image_hw)
    assert f"{image_hw[0]}x{image_hw[1]}" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("changed", "named"),
    [
        ({"cx": 320.0}, "cx=320"),
        ({"cy": -1.0}, "cy=-1"),
        ({"cx": float("nan")}, "cx=nan"),
    ],
)
def test_numbers_that_belong_to_no_such_image_are_refused(
    changed: dict[str, float], named: str
) -> None:
    values = {"fx": 100, "fy": 110, "cx": 31.5, "cy": 20, "height": 48, "width": 64}
    with pytest.raises(InputError, match=named):
        Camera(**{**values, **changed})  # type: ignore[arg-type]
