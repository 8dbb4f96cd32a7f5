"""The picture of a masker: its data, and that it can be drawn."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from rgbt.maskers.sketch import GREY, draw, greyed
from tests.maskers.test_masker import configured


def test_hidden_cells_are_grey_and_the_rest_is_the_image() -> None:
    image = np.full((6, 64, 3), 200, np.uint8)
    hidden = torch.tensor([[True, False, False, True]])
    found = greyed(image, hidden)
    assert found.shape == (32, 64, 3)
    assert (found[:, :16] == GREY).all()
    assert (found[:, 48:] == GREY).all()
    assert (found[:6, 16:48] == 200).all()
    assert not found[6:, 16:48].any()


def test_picture_of_two_examples_can_be_drawn(tmp_path) -> None:
    masker = configured("crm", pairing="comp")
    examples = [
        SimpleNamespace(
            rgb=np.full((*hw, 3), 200, np.uint8),
            thermal=np.full(hw, 50, np.float32),
            centre_yx=(hw[0] // 2, hw[1] // 2),
            name="a",
        )
        for hw in ((64, 96), (32, 64))
    ]
    figure = draw(masker, examples, 0, "title")
    # In the last column, the share of draws in which a cell is hidden.
    rgb, thermal = (axis.images[0].get_array() for axis in figure.axes[2::3])
    np.testing.assert_allclose(rgb + thermal, 1)
    assert rgb.mean() == pytest.approx(0.5)
    assert 0.4 < rgb.min() < rgb.max() < 0.6
    path = tmp_path / "masks.png"
    figure.savefig(path, dpi=40)
    assert path.stat().st_size > 1000
