"""Mirrored images, windows and scales of a prediction, and the sizes at which it is counted."""

from __future__ import annotations

from dataclasses import replace
from math import ceil, exp
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.engine.evaluate import class_maps, confident_class_maps, probabilities
from rgbt.engine.prediction import Prediction
from rgbt.types import Batch, Output

FABRIC = Fabric(accelerator="cpu", devices=1)


class Ramp(nn.Module):
    """Two classes whose scores depend on the grey value and on the column in the given image."""

    def forward(self, rgb: Tensor, thermal: Tensor, **_: Any) -> Output:
        column = torch.arange(rgb.shape[-1], dtype=torch.float32).expand(len(rgb), *rgb.shape[2:])
        return Output(torch.stack([4 * rgb[:, 0], column / 3 + thermal[:, 0]], 1), {})


def batch(image: list[list[float]], label_hw: tuple[int, int] | None = None) -> Batch:
    grey = torch.tensor(image)[None, None]
    hw = label_hw or tuple(grey.shape[-2:])
    return Batch(
        rgb=grey.expand(1, 3, -1, -1),
        thermal=grey * 0.5,
        label=torch.zeros(1, *hw, dtype=torch.int64),
        name=("a",),
        centre_yx=torch.zeros(1, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.tensor([hw]),
    )


def share(grey: float, column: int) -> float:
    """Probability of class 0 in plain Python."""
    one, other = exp(4 * grey), exp(column / 3 + grey * 0.5)
    return one / (one + other)


def predicted(data: Batch, **settings: Any) -> np.ndarray:
    shares = probabilities(Ramp(), data, FABRIC, settings=Prediction(**settings))
    return np.asarray(shares[0, 0])


ROW = [0.9, 0.1, 0.4, 0.3, 0.8, 0.2, 0.7]


def test_mirrored_probabilities_are_the_mean_of_both_images() -> None:
    data = batch([ROW, ROW[::-1]])
    width = len(ROW)
    expected = [
        [(share(g, j) + share(g, width - 1 - j)) / 2 for j, g in enumerate(row)]
        for row in (ROW, ROW[::-1])
    ]
    np.testing.assert_allclose(predicted(data, mirrored=True), expected, atol=1e-6)
    assert np.abs(predicted(data) - expected).max() > 0.05


def by_hand(side: int, stride: float) -> list[float]:
    """semseg's windows over one row, one pixel after the other."""
    width, step = len(ROW), ceil(side * stride)
    sums, counts = [0.0] * width, [0] * width
    for index in range(ceil((width - side) / step) + 1):
        start = min(index * step + side, width) - side
        for j in range(side):
            mirrored = share(ROW[start + j], side - 1 - j)
            sums[start + j] += (share(ROW[start + j], j) + mirrored) / 2
            counts[start + j] += 1
    return [total / count for total, count in zip(sums, counts, strict=True)]


@pytest.mark.parametrize("side", [3, 4, 5, 7])
def test_windows_are_those_of_semseg(side: int) -> None:
    data = batch([ROW] * 4)
    shares = predicted(data, mirrored=True, window_hw=(3, side))
    np.testing.assert_allclose(shares, [by_hand(side, 2 / 3)] * 4, atol=1e-6)


def test_scales_are_averaged_at_the_size_of_the_label() -> None:
    """Twice the size of a constant image shows twice the columns; both are enlarged to 2 x 4."""
    data = batch([[0.5, 0.5]], (1, 4))

    def enlarged(shares: list[float]) -> np.ndarray:
        """Half-pixel centres, bilinear, to four columns."""
        at = (np.arange(4) + 0.5) * len(shares) / 4 - 0.5
        return np.interp(at, range(len(shares)), shares)

    one = enlarged([share(0.5, j) for j in range(2)])
    two = enlarged([share(0.5, j) for j in range(4)])
    np.testing.assert_allclose(predicted(data, scales=(1.0, 2.0))[0], (one + two) / 2, atol=1e-6)


def test_aligned_corners_enlarge_the_scores() -> None:
    """Scores 0 and 2 less 1/3: at three times as many columns, aligned corners give equal steps."""
    data = batch([[0.0, 0.5]], (1, 4))
    difference = np.array([0.0, 2.0 - (1 / 3 + 0.25)])
    for aligned, at in ((True, [0, 1 / 3, 2 / 3, 1]), (False, [0, 0.25, 0.75, 1])):
        expected = 1 / (1 + np.exp(-np.interp(at, [0, 1], difference)))
        np.testing.assert_allclose(predicted(data, align_corners=aligned)[0], expected, atol=1e-6)


def test_classes_and_confidences_agree_with_the_probabilities() -> None:
    data = batch([ROW, ROW[::-1]], (4, 14))
    settings = Prediction(mirrored=True, window_hw=(2, 4), align_corners=True)
    shares = probabilities(Ramp(), data, FABRIC, settings=settings)
    classes, confidence = confident_class_maps(Ramp(), data, FABRIC, settings=settings)
    assert torch.equal(classes.long(), shares.argmax(1))
    torch.testing.assert_close(confidence, shares.amax(1))
    assert torch.equal(class_maps(Ramp(), data, FABRIC, settings=settings), classes)
    torch.testing.assert_close(shares.sum(1), torch.ones(1, 4, 14))


def test_default_prediction_is_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[int] = []
    model = Ramp()
    model.register_forward_hook(lambda *_: calls.append(1))
    class_maps(model, batch([ROW]), FABRIC)
    assert len(calls) == 1
    mirrored = replace(Prediction(), mirrored=True, scales=(1.0, 2.0))
    class_maps(model, batch([ROW]), FABRIC, settings=mirrored)
    assert len(calls) == 1 + 4
