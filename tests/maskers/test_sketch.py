"""The picture of a masker: its data, and that it can be drawn."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from rgbt.maskers.masker import Masker
from rgbt.maskers.sketch import GREY, draw, sketch


@pytest.fixture
def masker() -> Masker:
    return Masker(
        sampler="uniform",
        patch_size=16,
        ratio=0.5,
        sigma_div=None,
        sigma_height=None,
        anchor=None,
        cell_position=None,
        pairing="comp",
        pattern_probabilities=None,
    )


def example(height: int, width: int) -> SimpleNamespace:
    return SimpleNamespace(
        rgb=np.full((height, width, 3), 200, np.uint8),
        thermal=np.full((height, width), 50, np.float32),
        centre_yx=(height // 2, width // 2),
        name=f"{height}x{width}",
    )


def test_hidden_cells_are_grey_and_the_rest_is_the_image(masker) -> None:
    data = sketch(masker, [example(64, 96), example(32, 64)], seed=0, draws=500)
    for rgb, thermal in zip(data.rgb, data.thermal, strict=True):
        # Complementary halves: where RGB is grey, thermal is not.
        assert ((rgb[..., 0] == GREY) != (thermal == GREY)).all()
        assert (rgb[..., 0] == GREY).mean() == 0.5
        assert set(np.unique(rgb)) == {200, GREY}
    assert data.names == ("64x96", "32x64")
    assert data.rgb_frequency.shape == (4, 6)
    np.testing.assert_allclose(data.rgb_frequency + data.thermal_frequency, 1)
    assert data.rgb_frequency.mean() == pytest.approx(0.5)


def test_it_can_be_drawn(masker, tmp_path) -> None:
    path = tmp_path / "masks.png"
    draw(sketch(masker, [example(64, 96)], seed=0, draws=10), "title").savefig(path, dpi=40)
    assert path.stat().st_size > 1000
