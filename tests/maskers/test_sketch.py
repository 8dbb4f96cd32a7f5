"""The picture of a masker: its data, and that it can be drawn."""

from __future__ import annotations

import numpy as np
import torch

from rgbt.maskers.sketch import GREY, greyed


def test_hidden_cells_are_grey_on_the_image() -> None:
    image = np.full((6, 64, 3), 200, np.uint8)
    hidden = torch.tensor([[True, False, False, True]])
    found = greyed(image, hidden)
    assert found.shape == (32, 64, 3)
    assert (found[:, :16] == GREY).all()
    assert (found[:, 48:] == GREY).all()
    assert (found[:6, 16:48] == 200).all()
    assert not found[6:, 16:48].any()
