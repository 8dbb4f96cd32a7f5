"""Multi-head, Fig. 3."""

from __future__ import annotations

import numpy as np
import torch

from analysis.figures.gradients import gradient_curves


def test_gradients_by_hand_and_by_automatic_differentiation() -> None:
    p, entropy, squares = gradient_curves(3)  # 1/4, 1/2, 3/4
    np.testing.assert_allclose(p, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(entropy, [np.log2(3), 0, np.log2(3)])
    np.testing.assert_allclose(squares, [0.5, 0, 0.5])
    p, entropy, squares = gradient_curves(99)
    p = torch.tensor(p, requires_grad=True)
    printed = -(p * p.log() + (1 - p) * (1 - p).log()) / np.log(2)
    (by_entropy,) = torch.autograd.grad(printed.sum(), p)
    (by_squares,) = torch.autograd.grad(-(p**2 + (1 - p) ** 2).sum() / 2, p)
    np.testing.assert_allclose(entropy, by_entropy.abs(), atol=1e-12)
    np.testing.assert_allclose(squares, by_squares.abs(), atol=1e-12)
