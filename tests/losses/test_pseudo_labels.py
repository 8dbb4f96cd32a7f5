"""Pseudo-labels by hand: classes, both weights, rows without a label, no gradient."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from rgbt.losses.pseudo_labels import pseudo_labels


def scores() -> Tensor:
    """(2, 2, 2, 2): highest probabilities of the first image 0.9, 0.8, 0.6, 0.6; then 0.9 once."""
    first = torch.tensor([[[0.9, 0.2], [0.4, 0.6]], [[0.9, 0.5], [0.5, 0.5]]], dtype=torch.float64)
    return torch.stack([first, 1 - first], dim=1).log()


def test_classes_and_share_of_confident_pixels() -> None:
    found = pseudo_labels(scores(), 0.8, "batch", (0.0, 0.0))
    assert found.label.tolist() == [[[0, 1], [1, 0]], [[0, 0], [0, 0]]]
    assert found.label.dtype == torch.int64
    # 0.9 and 0.8 of the first image, 0.9 of the second: 3 of 8 pixels.
    assert found.confident.item() == 3 / 8
    torch.testing.assert_close(found.weight, torch.full((2, 2, 2), 3 / 8))
    means = (0.9 + 0.8 + 0.6 + 0.6 + 0.9 + 0.5 + 0.5 + 0.5) / 8
    assert found.confidence.item() == pytest.approx(means)


def test_share_of_each_image() -> None:
    found = pseudo_labels(scores(), 0.8, "image", (0.0, 0.0))
    assert found.weight[0].unique().tolist() == [0.5]
    assert found.weight[1].unique().tolist() == [0.25]
    assert found.confident.item() == 3 / 8


@pytest.mark.parametrize("weighted_by", ["batch", "image"])
def test_rows_at_the_borders_have_no_weight(weighted_by: str) -> None:
    tall = scores().repeat(1, 1, 5, 1)  # ten rows
    plain = pseudo_labels(tall, 0.8, weighted_by, (0.0, 0.0))  # type: ignore[arg-type]
    found = pseudo_labels(tall, 0.8, weighted_by, (0.1, 0.3))  # type: ignore[arg-type]
    assert not found.weight[:, :1].any()
    assert not found.weight[:, 7:].any()
    assert torch.equal(found.weight[:, 1:7], plain.weight[:, 1:7])
    # The share is that of all rows, as released.
    assert torch.equal(found.confident, plain.confident)


def test_no_gradient_passes() -> None:
    leaf = scores().requires_grad_()
    found = pseudo_labels(leaf, 0.8, "batch", (0.0, 0.0))
    assert not any(each.requires_grad for each in found)
