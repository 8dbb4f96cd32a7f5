"""Losses of bfloat16 outputs are computed in float32, inside and outside of autocast."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from rgbt.losses.cross_entropy import CrossEntropy, WithAuxiliary
from rgbt.losses.distances import sdc, sdn
from rgbt.losses.spatial import SpatialWeight
from rgbt.losses.temporal import TemporalLoss, con, con_acc, dice
from rgbt.losses.unlabelled import VERDICT_LOSSES, Entropy, MaxSquares, judged
from rgbt.types import Frame, Output
from tests.losses.problems import batch_of, criterion_of, seeded, whole_image

B, K, H, W = 2, 5, 16, 24
LABEL = torch.randint(0, K, (B, H, W), generator=seeded(1))
LABEL[:, :3] = 255
BATCH = batch_of(LABEL, whole_image(B, H, W))
VALID = torch.rand(B, H, W, generator=seeded(2)) < 0.8
CE = CrossEntropy(class_weights=None)
EDGE = SpatialWeight(
    **{"alpha": 2.0, "focus": "edge", "centre": "tracked", "d_max": "original", "padding": "map"},
    **{"normaliser": "points", "dice_smoothing": "one", "match": "weighted", "passes": "all"},
)


def drawn(*shape: int, seed: int) -> Tensor:
    """Numbers that bfloat16 has, so that only the arithmetic can differ."""
    return (3 * torch.randn(*shape, generator=seeded(seed))).bfloat16().float()


SCORES, OTHERS, VERDICTS = drawn(B, K, H, W, seed=3), drawn(B, K, H, W, seed=4), drawn(B, 8, seed=5)
P, Q = (each.softmax(1).bfloat16().float() for each in (SCORES, OTHERS))
CLASSES = drawn(2, 3, B, 6, K + 1, seed=6)
MASKS = drawn(2, 3, B, 6, H // 4, W // 4, seed=7)
Loss = Callable[..., dict[str, Tensor]]


def of_sets(spatial: bool) -> Loss:
    criterion = criterion_of(num_classes=K, **({"spatial": EDGE} if spatial else {}))

    def loss(classes: Tensor, masks: Tensor) -> dict[str, Tensor]:
        aux = {"class_logits": classes, "mask_logits": masks}
        return criterion(Output(None, aux), BATCH, seeded())

    return loss


def of_frames(second: str, form: str) -> Loss:
    criterion = TemporalLoss(segmentation=CE, alpha=1.0, beta=1.0, second=second, form=form)  # type: ignore[arg-type]

    def loss(a: Tensor, b: Tensor) -> dict[str, Tensor]:
        frames = (Frame(Output(each, {}), BATCH, each) for each in (a, b))
        return criterion(*frames, a.float().softmax(1), VALID, seeded())

    return loss


def named(loss: Callable[..., Tensor]) -> Loss:
    return lambda *values: {"loss": loss(*values)}


def confident(scores: Tensor) -> dict[str, Tensor]:
    share = torch.linspace(0, 1, B * H * W).view(B, H, W)
    return CE(Output(scores, {}), replace(BATCH, confidence=share), seeded())


AUXILIARY = WithAuxiliary(loss=CE, weight=0.4)
LOSSES: dict[str, tuple[Loss, tuple[Tensor, ...]]] = {
    "set criterion": (of_sets(False), (CLASSES, MASKS)),
    "spatial": (of_sets(True), (CLASSES, MASKS)),
    "sdc": (lambda a, b: {"sdc": sdc(a, b)}, (CLASSES[0, 0], CLASSES[1, 0])),
    "sdn": (lambda a, b, c: {"sdn": sdn(a, b, c)}, tuple(CLASSES[0])),
    "cross-entropy": (lambda s: CE(Output(s, {}), BATCH, seeded()), (SCORES,)),
    "with confidence": (confident, (SCORES,)),
    "auxiliary": (
        lambda s, a: AUXILIARY(Output(s, {"aux_logits": a}), BATCH, seeded()),
        (SCORES, OTHERS),
    ),
    **{
        f"{second} {form}": (of_frames(second, form), (SCORES, OTHERS))
        for second in ("dice", "con", "con_acc")
        for form in ("paper", "released")
    },
    "dice of probabilities": (named(lambda p: dice(p, LABEL, "paper")), (P,)),
    "con of probabilities": (named(lambda p, q: con(p, q, VALID, "paper")), (P, Q)),
    "con_acc of probabilities": (
        named(lambda p, q: con_acc(p, q, LABEL, "released")),
        (P, Q),
    ),
    **{
        name: (lambda v, f=verdict: {"verdict": f(v, 0.25)}, (VERDICTS,))
        for name, verdict in VERDICT_LOSSES.items()
    },
    **{
        f"judged {how}": (
            lambda s, how=how: {"mean": judged(s, how).square().mean()},
            (SCORES,),
        )
        for how in ("probabilities", "logits", "self_information")
    },
    "entropy": (Entropy(weight=1.0), (P,)),
    **{
        f"max squares {ratio}": (
            lambda s, ratio=ratio: MaxSquares(
                weight=1.0, normalisation="pixels", image_wise_ratio=ratio
            )(s),
            (P,),
        )
        for ratio in (None, 0.2)
    },
}


def computed(
    loss: Loss, values: tuple[Tensor, ...], dtype: torch.dtype
) -> tuple[dict[str, Tensor], list[Tensor]]:
    """The parts and the gradients."""
    inputs = [value.to(dtype, copy=True).requires_grad_() for value in values]
    parts = loss(*inputs)
    torch.stack([part.sum() for part in parts.values()]).sum().backward()
    gradients = [each.grad for each in inputs if each.grad is not None]
    return {name: part.detach() for name, part in parts.items()}, gradients


@pytest.mark.parametrize("autocast", [False, True])
@pytest.mark.parametrize("name", LOSSES)
def test_loss_of_half_precision_is_that_of_single(name: str, autocast: bool) -> None:
    loss, values = LOSSES[name]
    expected, gradients = computed(loss, values, torch.float32)
    with torch.autocast("cpu", torch.bfloat16, enabled=autocast):
        found, rounded = computed(loss, values, torch.bfloat16)
    assert {part.dtype for part in found.values()} == {torch.float32}
    assert all(torch.equal(found[part], value) for part, value in expected.items())
    # Gradients are rounded once for each part that reads a value.
    for single, half in zip(gradients, rounded, strict=True):
        largest = float(single.abs().max())
        torch.testing.assert_close(half.float(), single, rtol=2**-7, atol=2**-9 * largest)
