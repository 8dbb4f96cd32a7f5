"""Labels from two heads: by hand, pixel by pixel."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.losses.unlabelled import guidance


def maps(*pixels: tuple[float, ...]) -> Tensor:
    """(1, K, 1, pixels)."""
    return torch.tensor(pixels).T[None, :, None]


def test_labels_by_hand() -> None:
    p = maps((0.96, 0.04), (0.5, 0.5), (0.6, 0.4), (0.95, 0.05), (0.03, 0.97))
    q = maps((0.60, 0.40), (0.01, 0.99), (0.7, 0.3), (0.95, 0.05), (0.98, 0.02))
    found = guidance(p, q, 0.95)
    # Sure p; sure q; nobody; not above the threshold; both, and the mean is (0.505, 0.495).
    assert found.tolist() == [[[0, 1, 255, 255, 0]]]
    assert found.dtype == torch.int64


def test_thresholds_at_the_ends() -> None:
    p, q = maps((1.0, 0.0), (0.4, 0.6)), maps((0.2, 0.8), (0.5, 0.5))
    assert guidance(p, q, 0.0).tolist() == [[[0, 1]]]
    assert guidance(p, q, 1.0).tolist() == [[[255, 255]]]


def test_no_gradient_goes_through() -> None:
    p = maps((0.96, 0.04)).requires_grad_()
    assert not guidance(p, p, 0.5).requires_grad


def test_raises() -> None:
    p = torch.full((1, 2, 3, 4), 0.5)
    with pytest.raises(ValueError, match="aux_probabilities: expected shape"):
        guidance(p, p[..., 1:], 0.95)
    with pytest.raises(InputError, match="threshold must lie in"):
        guidance(p, p, 1.5)
