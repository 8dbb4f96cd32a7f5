"""Losses of bfloat16 outputs are computed in float32, inside and outside of autocast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from rgbt.losses.cross_entropy import CrossEntropy
from rgbt.losses.distances import sdc
from rgbt.losses.spatial import PLAIN
from rgbt.losses.temporal import TemporalLoss
from rgbt.losses.unlabelled import VERDICT_LOSSES, Entropy, MaxSquares, judged
from rgbt.types import Frame, Output
from tests.losses.problems import batch_of, criterion_of, seeded, whole_image

B, K, H, W = 2, 5, 16, 24
LABEL = torch.randint(0, K, (B, H, W), generator=seeded(1))
LABEL[:, :3] = 255
BATCH = batch_of(LABEL, whole_image(B, H, W))
CONFIDENT = replace(BATCH, confidence=torch.linspace(0, 1, B * H * W).view(B, H, W))
VALID = torch.rand(B, H, W, generator=seeded(2)) < 0.8
CE = CrossEntropy(class_weights=None)
EDGE = replace(PLAIN, alpha=2.0, focus="edge", match="weighted")


def drawn(*shape: int, seed: int) -> Tensor:
    """Numbers that bfloat16 has, so that only the arithmetic can differ."""
    return (3 * torch.randn(*shape, generator=seeded(seed))).bfloat16().float()


SCORES, OTHERS, VERDICTS = drawn(B, K, H, W, seed=3), drawn(B, K, H, W, seed=4), drawn(B, 8, seed=5)
P = SCORES.softmax(1).bfloat16().float()
CLASSES = drawn(2, 3, B, 6, K + 1, seed=6)
MASKS = drawn(2, 3, B, 6, H // 4, W // 4, seed=7)
Loss = Callable[..., dict[str, Tensor]]


def of_sets(classes: Tensor, masks: Tensor) -> dict[str, Tensor]:
    criterion = criterion_of(num_classes=K, spatial=EDGE)
    output = Output(None, {"class_logits": classes, "mask_logits": masks})
    return criterion(output, BATCH, seeded())


def of_frames(second: Any) -> Loss:
    criterion = TemporalLoss(segmentation=CE, alpha=1.0, beta=1.0, second=second, form="paper")

    def loss(a: Tensor, b: Tensor) -> dict[str, Tensor]:
        frames = (Frame(Output(each, {}), BATCH, each) for each in (a, b))
        return criterion(*frames, a.float().softmax(1), VALID, seeded())

    return loss


LOSSES: dict[str, tuple[Loss, tuple[Tensor, ...]]] = {
    "set criterion": (of_sets, (CLASSES, MASKS)),
    "sdc": (lambda a, b: {"sdc": sdc(a, b)}, (CLASSES[0, 0], CLASSES[1, 0])),
    "cross-entropy": (lambda s: CE(Output(s, {}), CONFIDENT, seeded()), (SCORES,)),
    **{each: (of_frames(each), (SCORES, OTHERS)) for each in ("dice", "con", "con_acc")},
    **{n: (lambda v, f=f: {"d": f(v, 0.25)}, (VERDICTS,)) for n, f in VERDICT_LOSSES.items()},
    "judged": (lambda s: {"m": judged(s, "self_information").square().mean()}, (SCORES,)),
    "entropy": (Entropy(weight=1.0), (P,)),
    "squares": (MaxSquares(weight=1, normalisation="pixels", image_wise_ratio=0.2), (P,)),
}


def computed(
    loss: Loss, values: tuple[Tensor, ...], dtype: torch.dtype
) -> tuple[list[Tensor], list[Tensor]]:
    """The parts and the gradients."""
    inputs = [value.to(dtype, copy=True).requires_grad_() for value in values]
    parts = list(loss(*inputs).values())
    torch.stack([part.sum() for part in parts]).sum().backward()
    return [part.detach() for part in parts], [x.grad for x in inputs if x.grad is not None]


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("name", LOSSES)
def test_loss_of_half_precision_is_that_of_single(name: str, autocast: bool) -> None:
    loss, values = LOSSES[name]
    expected, gradients = computed(loss, values, torch.float32)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        found, rounded = computed(loss, values, torch.bfloat16)
    assert {part.dtype for part in found} == {torch.float32}
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    # Gradients are rounded once for each part that reads a value.
    for single, half in zip(gradients, rounded, strict=True):
        largest = float(single.abs().max())
        torch.testing.assert_close(half.float(), single, rtol=2**-7, atol=2**-9 * largest)
