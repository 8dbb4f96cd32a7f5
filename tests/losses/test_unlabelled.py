"""Maximum squares and entropy: values by hand, gradients, edges of the range."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.losses.unlabelled import Entropy, MaxSquares, guidance
from tests.losses.problems import seeded


def squares(
    p: Tensor, normalisation: str = "pixels", ratio: float | None = None, weight: float = 1.0
) -> Tensor:
    values: Any = {"normalisation": normalisation, "image_wise_ratio": ratio, "weight": weight}
    return MaxSquares(**values)(p)["max_squares"]


def entropy(p: Tensor, weight: float = 1.0) -> Tensor:
    return Entropy(weight=weight)(p)["entropy"]


def constant(values: tuple[float, ...]) -> Tensor:
    """(2, K, 3, 5) with the same probabilities everywhere."""
    return torch.tensor(values).view(1, -1, 1, 1).expand(2, len(values), 3, 5)


UNIFORM = (1 / 14,) * 14
ONE_HOT = (0.0,) * 3 + (1.0,) + (0.0,) * 10
SURE = (0.7, 0.2, 0.1)


@pytest.mark.parametrize(
    ("values", "pixels", "entries", "surprise"),
    [
        (UNIFORM, -0.0357143, -0.00255102, 1.0),  # 14 / 14^2 / 2; 1 / 14 of that
        (ONE_HOT, -0.5, -0.0357143, 0.0),
        (SURE, -0.27, -0.09, 0.729847),  # 0.54 / 2; 0.8018186 nats of 1.0986123
    ],
)
def test_values_by_hand(
    values: tuple[float, ...], pixels: float, entries: float, surprise: float
) -> None:
    p = constant(values)
    assert squares(p).item() == pytest.approx(pixels, abs=1e-7)
    assert squares(p, "entries").item() == pytest.approx(entries, abs=1e-7)
    assert entropy(p).item() == pytest.approx(surprise, abs=1e-6)
    assert squares(p, weight=0.1).item() == pytest.approx(0.1 * pixels, abs=1e-7)
    assert entropy(p, weight=0.25).item() == pytest.approx(0.25 * surprise, abs=1e-6)
    assert squares(p).shape == entropy(p).shape == ()


def by_loops(p: Tensor, ratio: float) -> float:
    """-sum of w p^2 over pixels and classes and images."""
    total = 0.0
    for image in p.tolist():
        pixels = list(zip(*(sum(rows, []) for rows in image), strict=True))
        predicted = [max(range(len(pixel)), key=pixel.__getitem__) for pixel in pixels]
        for pixel, k in zip(pixels, predicted, strict=True):
            size = predicted.count(k) ** ratio * len(pixels) ** (1 - ratio)
            total -= sum(value**2 for value in pixel) / max(size, 1)
    return total


@pytest.mark.parametrize("ratio", [0.0, 0.2, 0.7, 1.0])
def test_image_wise_weights_against_loops(ratio: float) -> None:
    generator = seeded(0)
    p = (2 * torch.randn(3, 4, 5, 6, generator=generator, dtype=torch.float64)).softmax(1)
    total = by_loops(p, ratio)
    assert squares(p, "pixels", ratio).item() == pytest.approx(total / (2 * 3), rel=1e-9)
    assert squares(p, "entries", ratio).item() == pytest.approx(total / (3 * 4), rel=1e-9)


@pytest.mark.parametrize("ratio", [None, 0.2])
@pytest.mark.parametrize("normalisation", ["pixels", "entries"])
def test_gradient_of_max_squares(normalisation: str, ratio: float | None) -> None:
    generator = seeded(1)
    scores = torch.randn(2, 3, 2, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(
        lambda s: squares(s.softmax(1), normalisation, ratio, 0.1), (scores,)
    )


def test_gradient_of_entropy() -> None:
    generator = seeded(2)
    scores = torch.randn(2, 3, 2, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda s: entropy(s.softmax(1)), (scores,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16, torch.float16])
def test_large_scores_give_finite_values_and_gradients(dtype: torch.dtype) -> None:
    scores = torch.tensor([1e4, -1e4, 0.0, 1e4]).to(dtype).view(1, 4, 1, 1).repeat(1, 1, 2, 2)
    for loss in (
        squares,
        entropy,
        lambda p: squares(p, "entries", 0.2),
        lambda p: squares(p, "pixels", 1.0),
    ):
        leaf = scores.clone().requires_grad_()
        p = leaf.softmax(1)
        assert (p == 0).any()
        value = loss(p)
        assert value.dtype == torch.float32
        assert value.isfinite()
        value.backward()
        assert leaf.grad is not None
        assert leaf.grad.isfinite().all()


def test_of_one_class_there_is_nothing_to_be_unsure_of() -> None:
    p = torch.ones(2, 1, 3, 5, requires_grad=True)
    assert entropy(p).item() == 0
    assert squares(p).item() == squares(p, "entries").item() == -0.5
    entropy(p).backward()
    assert p.grad is not None
    assert p.grad.isfinite().all()


def maps(*pixels: tuple[float, ...]) -> Tensor:
    """(1, K, 1, pixels)."""
    return torch.tensor(pixels).T[None, :, None]


def test_guidance_by_hand() -> None:
    p = maps((0.96, 0.04), (0.5, 0.5), (0.6, 0.4), (0.95, 0.05), (0.03, 0.97))
    q = maps((0.60, 0.40), (0.01, 0.99), (0.7, 0.3), (0.95, 0.05), (0.98, 0.02))
    found = guidance(p, q, 0.95)
    # Sure p; sure q; nobody; not above the threshold; both, and the mean is (0.505, 0.495).
    assert found.tolist() == [[[0, 1, 255, 255, 0]]]
    assert found.dtype == torch.int64


def test_guidance_at_the_ends_of_the_threshold() -> None:
    p, q = maps((1.0, 0.0), (0.4, 0.6)), maps((0.2, 0.8), (0.5, 0.5))
    assert guidance(p, q, 0.0).tolist() == [[[0, 1]]]
    assert guidance(p, q, 1.0).tolist() == [[[255, 255]]]


def test_guidance_has_no_gradient() -> None:
    p = maps((0.96, 0.04)).requires_grad_()
    assert not guidance(p, p, 0.5).requires_grad


def test_guidance_refuses_what_does_not_fit() -> None:
    p = torch.full((1, 2, 3, 4), 0.5)
    with pytest.raises(ValueError, match="aux_probabilities: expected shape"):
        guidance(p, p[..., 1:], 0.95)
