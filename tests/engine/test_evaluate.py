"""Predictions: several heads, mirrored images, windows, scales, and the size of the label."""

from __future__ import annotations

from math import ceil, exp
from typing import Any

import numpy as np
import pytest
import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rgbt.checks import RunError
from rgbt.engine.evaluate import class_maps, class_scores, label_scores, shares
from rgbt.engine.prediction import Prediction
from rgbt.randomness import torch_generator
from rgbt.types import Batch, Output, View

FABRIC = Fabric(accelerator="cpu", devices=1)
HEADS = ("day", "night", "dusk")


def batch_of(rgb: Tensor, thermal: Tensor, label_hw: tuple[int, ...]) -> Batch:
    size = len(rgb)
    return Batch(
        rgb=rgb,
        thermal=thermal,
        label=torch.zeros(size, *label_hw, dtype=torch.int64),
        name=tuple(map(str, range(size))),
        centre_yx=torch.zeros(size, 2, dtype=torch.int64),
        position=None,
        original_hw=torch.tensor([label_hw] * size),
    )


class Heads(nn.Module):
    """Scores that show image, view and head; records its arguments."""

    def __init__(self) -> None:
        super().__init__()
        torch.manual_seed(0)
        self.backbone = nn.Sequential(nn.Conv2d(4, 6, 3, padding=1), nn.BatchNorm2d(6), nn.ReLU())
        self.heads = nn.ModuleDict({name: nn.Conv2d(6, 5, 1) for name in HEADS})
        self.calls: list[tuple[Any, ...]] = []

    def forward(self, rgb: Tensor, thermal: Tensor, *, views: Any = (), head: str) -> Output:
        self.calls.append((len(rgb), views, head))
        image = torch.cat([rgb * (views != ("thermal",)), thermal * (views != ("rgb",))], 1)
        return Output(self.heads[head](self.backbone(image)), {})


def drawn(size: int = 7) -> Batch:
    draw = torch_generator(0, "images")
    rgb, thermal = (torch.rand(size, c, 6, 8, generator=draw) for c in (3, 1))
    return batch_of(rgb, thermal, (12, 16))


@pytest.fixture
def model() -> Heads:
    return Heads().eval()


@pytest.mark.parametrize("view", [None, "rgb", "thermal"])
@pytest.mark.parametrize("chosen", [(0, 1, 0, 0, 1, 2, 0), (2, 2, 1, 1, 0, 0, 0), (1,) * 7])
def test_mixed_heads_equal_every_image_alone(
    model: Heads, chosen: tuple[int, ...], view: View | None
) -> None:
    images, heads = drawn(), tuple(HEADS[index] for index in chosen)
    found = class_scores(model, images, view, heads)
    assert len(model.calls) == len(set(heads)), "one pass for each head"
    requested: dict[str, Any] = {} if view is None else {"views": (view,)}
    for index, head in enumerate(heads):
        rgb, thermal = images.rgb[index : index + 1], images.thermal[index : index + 1]
        alone = model(rgb, thermal, head=head, **requested).logits[0]
        torch.testing.assert_close(found[index], alone, atol=1e-6, rtol=1e-5)
    classes = class_maps(model, images, FABRIC, view, heads)
    assert (classes.shape, classes.dtype) == ((7, 12, 16), torch.uint8)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_scores_not_finite_are_refused_with_the_image(model: Heads, value: float) -> None:
    data = drawn(3)
    data.rgb[1, 0, 2, 3] = value
    with pytest.raises(RunError, match="^image '1': the network's class scores are NaN or inf"):
        class_maps(model, data, FABRIC, None, ("day",) * 3)


class Ramp(nn.Module):
    """Two classes whose scores depend on the grey value and on the column in the given image."""

    def forward(self, rgb: Tensor, thermal: Tensor, **_: Any) -> Output:
        column = torch.arange(rgb.shape[-1], dtype=torch.float32).expand(len(rgb), *rgb.shape[2:])
        return Output(torch.stack([4 * rgb[:, 0], column / 3 + thermal[:, 0]], 1), {})


def grey(image: list[list[float]], label_hw: tuple[int, ...] | None = None) -> Batch:
    pixels = torch.tensor(image)[None, None]
    return batch_of(pixels.expand(1, 3, -1, -1), pixels * 0.5, label_hw or tuple(pixels.shape[2:]))


def share(grey: float, column: int) -> float:
    """Probability of class 0 in plain Python."""
    one, other = exp(4 * grey), exp(column / 3 + grey * 0.5)
    return one / (one + other)


def probabilities(model: nn.Module, data: Batch, settings: Prediction) -> Tensor:
    return shares(label_scores(model, data, FABRIC, settings=settings), model)


def predicted(data: Batch, **settings: Any) -> np.ndarray:
    return np.asarray(probabilities(Ramp(), data, Prediction(**settings))[0, 0])


ROW = [0.9, 0.1, 0.4, 0.3, 0.8, 0.2, 0.7]


def by_hand(side: int, stride: float) -> list[float]:
    """semseg's windows over one row, one pixel after the other, each with its mirror."""
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
def test_mirrored_windows_are_those_of_semseg(side: int) -> None:
    shares = predicted(grey([ROW] * 4), mirrored=True, window_hw=(3, side))
    np.testing.assert_allclose(shares, [by_hand(side, 2 / 3)] * 4, atol=1e-6)


def test_scales_are_averaged_at_the_size_of_the_label() -> None:
    """Twice the size of a constant image shows twice the columns; both are enlarged to 1 x 4."""

    def enlarged(columns: int) -> np.ndarray:
        """Half-pixel centres, bilinear, to four columns."""
        at = (np.arange(4) + 0.5) * columns / 4 - 0.5
        return np.interp(at, range(columns), [share(0.5, j) for j in range(columns)])

    found = predicted(grey([[0.5, 0.5]], (1, 4)), scales=(1.0, 2.0))[0]
    np.testing.assert_allclose(found, (enlarged(2) + enlarged(4)) / 2, atol=1e-6)


def test_aligned_corners_enlarge_the_scores() -> None:
    """Scores 0 and 2 less 1/3: at three times as many columns, aligned corners give equal steps."""
    data = grey([[0.0, 0.5]], (1, 4))
    difference = np.array([0.0, 2.0 - (1 / 3 + 0.25)])
    for aligned, at in ((True, [0, 1 / 3, 2 / 3, 1]), (False, [0, 0.25, 0.75, 1])):
        expected = 1 / (1 + np.exp(-np.interp(at, [0, 1], difference)))
        np.testing.assert_allclose(predicted(data, align_corners=aligned)[0], expected, atol=1e-6)


def test_classes_agree_with_the_probabilities() -> None:
    data = grey([ROW, ROW[::-1]], (4, 14))
    settings = Prediction(mirrored=True, window_hw=(2, 4), align_corners=True)
    found = probabilities(Ramp(), data, settings)
    assert torch.equal(class_maps(Ramp(), data, FABRIC, settings=settings).long(), found.argmax(1))
    torch.testing.assert_close(found.sum(1), torch.ones(1, 4, 14))
