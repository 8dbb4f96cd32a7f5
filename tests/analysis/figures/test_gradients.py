"""Multi-head, Fig. 3."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from analysis.figures.gradients import draw, gradient_curves
from tests.analysis.figures.drawn import texts


def test_values_by_hand() -> None:
    curves = gradient_curves(3)  # 1/4, 1/2, 3/4
    np.testing.assert_allclose(curves.probability, [0.25, 0.5, 0.75])
    np.testing.assert_allclose(curves.entropy, [np.log2(3), 0, np.log2(3)])
    np.testing.assert_allclose(curves.maximum_squares, [0.5, 0, 0.5])


def test_agrees_with_automatic_differentiation_of_the_printed_losses() -> None:
    curves = gradient_curves(99)
    p = torch.tensor(curves.probability, requires_grad=True)
    entropy = -(p * p.log() + (1 - p) * (1 - p).log()) / np.log(2)
    (by_entropy,) = torch.autograd.grad(entropy.sum(), p)
    (by_squares,) = torch.autograd.grad(-(p**2 + (1 - p) ** 2).sum() / 2, p)
    np.testing.assert_allclose(curves.entropy, by_entropy.abs(), atol=1e-12)
    np.testing.assert_allclose(curves.maximum_squares, by_squares.abs(), atol=1e-12)


def test_one_is_linear_and_the_other_steep_at_the_ends() -> None:
    curves = gradient_curves()
    right = curves.probability > 0.5
    np.testing.assert_allclose(np.diff(curves.maximum_squares[right], 2), 0, atol=1e-12)
    assert curves.entropy[-1] / curves.entropy[len(right) * 3 // 4] == pytest.approx(6.3, abs=0.1)


def test_draws_both_by_name(tmp_path: Path) -> None:
    found = texts(draw(gradient_curves()), tmp_path)
    assert {"entropy minimisation", "maximum squares", "gradient magnitude"} <= set(found)
