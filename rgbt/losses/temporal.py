"""The loss of two frames of a scene (Temporal, Eqs. 2 to 4), and the soft overlaps that it is of.

The caller makes the second frame and warps the first prediction to it. A ratio is one of sums over
the batch, so that the sums are those of all processes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from rgbt.checks import InputError
from rgbt.geometry.warp import halved_label, halved_mean
from rgbt.losses.cross_entropy import single
from rgbt.processes import total
from rgbt.ranges import NonNegative
from rgbt.requirements import LossRecord, Requirement, record_of
from rgbt.types import IGNORE, Frame, Loss

Form = Literal["paper", "released"]  # the choices of Temporal's paper, or of its release

SIGMA = 1e-7  # keeps denominators above 0 (Temporal, Eq. 2; release)

OWN = ("dice", "con", "con_acc")


@dataclass(frozen=True, kw_only=True)
class TemporalLoss:
    """Adds the segmentation losses of two frames, Dice of the first, and a loss of the second.

        L = seg_1 + alpha dice_1 + seg_2 + beta X

    Source: Temporal, Eq. (4) with X = con; Table I for the other X, and for what is left out.
    Released: alpha = beta = 1; X is dice, con or con_acc.
    """

    segmentation: Loss  # loss of each frame; paper and release: cross-entropy
    alpha: NonNegative  # with 0, the Dice loss of the first frame is not computed
    beta: NonNegative  # 0 if and only if `second` is "none"
    second: Literal["none", "dice", "con", "con_acc"]  # X: of the second frame, or of both
    form: Form  # which form of dice, con and con_acc

    def __post_init__(self) -> None:
        if (self.second == "none") == bool(self.beta):
            raise InputError(
                f"loss.second={self.second} does not fit loss.beta={self.beta:g}: second=none "
                "requires 0, and every other a number above 0."
            )

    @property
    def record(self) -> LossRecord:
        """Require what the loss of a frame requires, and a scheme of two frames."""
        own = [Requirement("scheme", "frames", 2)]
        # As released, Dice and con_acc leave out class 0.
        if self.form == "released" and (self.alpha or self.second in ("dice", "con_acc")):
            own += [Requirement.of_background("loss.form=released")]
        compares = self.second in ("con", "con_acc")
        return LossRecord(
            requires=(*record_of(self.segmentation, LossRecord).requires, *own),
            frames=2,
            reads_warped=compares,
            compares_half=compares,
        )

    def __call__(
        self,
        first: Frame,
        second: Frame,
        warped: Tensor | None,
        valid: Tensor,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the weighted parts, which add up to L.

        Args:
            first: frame 1.
            second: frame 2, of the same sizes.
            warped: (B, K, H, W) probabilities of frame 1, warped to frame 2; only where the record
                says `reads_warped`. Or (B, K, ceil(H / 2), ceil(W / 2)): frame 2 is compared at
                half the size, by its scores averaged over 2x2 pixels, and by the label on which
                these pixels agree.
            valid: (B, H, W) bool of the size of `warped`, pixels of frame 2 that frame 1 shows;
                others do not count in "con" and "con_acc".
            generator: of the segmentation loss, frame 1 first.

        Returns:
            name -> () float32: the parts of the segmentation loss, passes summed, as <part>_1 and
            <part>_2 (seg_dice_1 where it has a dice of its own); "dice_1"; `second`.
        """
        parts = {}
        for number, frame in ((1, first), (2, second)):
            found = self.segmentation(frame.output, frame.batch, generator)
            for name, values in found.items():
                parts[f"{'seg_' * (name in OWN)}{name}_{number}"] = values.sum()
        if self.alpha:
            parts["dice_1"] = self.alpha * self._dice(first)
        if self.second == "dice":
            parts["dice_2"] = self.beta * self._dice(second)
        elif self.second != "none":
            assert warped is not None, "the record requires it"
            half = warped.shape[2:] != second.logits.shape[2:]
            scores, label = single(second.logits), second.batch.label
            p = (halved_mean(scores) if half else scores).softmax(1)
            if self.second == "con":
                value = con(warped, p, valid, self.form)
            else:
                label = halved_label(label) if half else label
                value = con_acc(warped, p, label.where(valid, IGNORE), self.form)
            parts[self.second] = self.beta * value
        return parts

    def _dice(self, frame: Frame) -> Tensor:
        return dice(single(frame.logits).softmax(1), frame.batch.label, self.form)


def dice(probabilities: Tensor, label: Tensor, form: Form) -> Tensor:
    """Compute Dice loss over all pixels of the batch that count, averaged over the K classes.

        paper      1 - mean_c  2 sum p_c y_c / sum (p_c^2 + y_c^2)
        released   mean_c of  1 - 2 sum p_c y_c / sum (p_c + y_c),  0 for a class without a pixel

    Source: Temporal, Sec. III-C, which cites V-Net and prints nothing more; V-Net's squares.
    Paper: background is a class like the others; a class without a pixel costs 1, without
    gradient, so that agreement costs the share of absent classes.   Released: pixels labelled 0
    are left out, yet K still divides: the range ends at the share of foreground classes present.

    p (B, K, H, W), y (B, H, W) int64, 255 is left out -> () in [0, 1], float32 for half precision
    too. Where no pixel counts: 1 (paper), 0 (released), with a gradient of 0.
    """
    probabilities = single(probabilities)
    target = _Target(label, probabilities, form)
    overlap = target.by_class(target.labelled(probabilities))
    size = target.counted(probabilities.square() if form == "paper" else probabilities)
    return target.averaged(1 - 2 * overlap / (size + target.pixels).clamp(min=SIGMA))


def con(warped: Tensor, second: Tensor, valid: Tensor, form: Form) -> Tensor:
    """Compute consistency loss: the soft overlap of two predictions, no label.

        1 - 1/K sum_c  2 sum p_c q_c / sum (p_c + q_c + sigma)

    Source: Temporal, Eq. (2), there over the pixels of one pair of images, here of the batch.
    Paper: sigma inside the sum.   Released: a denominator below sigma is sigma.
    In both forms, a class that neither frame predicts costs 1 (agreement of m classes of K costs
    1 - m / K) and agreement in doubt costs more than agreement without.

    p and q (B, K, H, W): probabilities of the first frame, warped to the second, and of the
    second; `valid` (B, H, W) bool: pixels that count, labelled or not. () in [0, 1], float32 for
    half precision too; 1, with a gradient of 0, where no pixel is valid. Differentiable once.
    """
    pairs = single(warped), single(second), valid
    sums: tuple[Tensor, Tensor] = _PairSums.apply(*pairs)  # type: ignore[no-untyped-call]
    overlap, size = total(sums[0]), total(sums[1])
    if form == "paper":
        size = size + SIGMA * total(valid.sum())
    # With sigma inside, no sum over at least one pixel lies below this.
    return (1 - 2 * overlap / size.clamp(min=SIGMA)).mean()


def con_acc(warped: Tensor, second: Tensor, label: Tensor, form: Form) -> Tensor:
    """Compute consistency and accuracy loss: the soft overlap of two predictions and the label y.

        1 - 1/K sum_c  f sum p_c q_c y_c / sum (p_c + q_c + y_c + sigma)

    Source: Temporal, Eq. (3); see `con`.
    Paper: f = 2, so that full agreement costs 1/3; a class without a pixel costs 1.   Released:
    f = 3; pixels labelled 0 are left out, a class without a pixel costs 0, K still divides.

    p and q as in `con`; y (B, H, W) int64 of the second frame, 255 is left out. In [1/3, 1] (paper)
    or [0, 1] (released). Where no pixel counts: 1 (paper), 0 (released), with a gradient of 0.
    """
    warped, second = single(warped), single(second)
    target = _Target(label, second, form)
    overlap = target.labelled(warped) * target.labelled(second)
    size = target.counted(warped + second) + target.pixels
    if form == "paper":
        size = size + SIGMA * total(target.weight.sum())
    factor = 2 if form == "paper" else 3
    return target.averaged(1 - factor * target.by_class(overlap) / size.clamp(min=SIGMA))


class _Target:
    """Says which pixels count: all labelled ones, or, as released, those of no background."""

    def __init__(self, label: Tensor, probabilities: Tensor, form: Form) -> None:
        counted = label != IGNORE
        if form == "released":
            counted &= label != 0
        self.form, self.num_classes = form, probabilities.shape[1]
        self.label = label.where(counted, 0)
        self.weight = counted.to(probabilities.dtype)
        self.pixels = self.by_class(self.weight)

    def labelled(self, probabilities: Tensor) -> Tensor:
        """Return the probability of the labelled class, (B, H, W), 0 where no pixel counts."""
        return probabilities.gather(1, self.label[:, None])[:, 0] * self.weight

    def by_class(self, values: Tensor) -> Tensor:
        """Sum (B, H, W) values over the pixels of each class, of all processes: (K,)."""
        rows = values.new_zeros(*values.shape[:2], self.num_classes)
        return total(rows.scatter_add(2, self.label, values).sum((0, 1)))

    def counted(self, values: Tensor) -> Tensor:
        """Sum (B, K, H, W) values over the pixels that count, of all processes: (K,)."""
        return total((values * self.weight[:, None]).sum((0, 2, 3)))

    def averaged(self, cost: Tensor) -> Tensor:
        """Average K costs; as released, classes without a pixel cost 0."""
        return cost.mean() if self.form == "paper" else cost.where(self.pixels > 0, 0.0).mean()


class _PairSums(torch.autograd.Function):
    """Sums p q and p + q over the pixels that count: (K,) each.

    The gradients are what automatic differentiation gives, without keeping masked copies: one pass
    for each of them.
    """

    @staticmethod
    def forward(ctx: Any, first: Tensor, second: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        ctx.save_for_backward(first, second, counted)
        weight = counted.to(first.dtype)
        products, sums = [], []
        for p, q in zip(first.unbind(1), second.unbind(1), strict=True):
            p = p * weight
            products.append((p * q).sum())
            sums.append((p + q * weight).sum())
        return torch.stack(products), torch.stack(sums)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, Tensor | None, None]:
        first, second, counted = ctx.saved_tensors
        by_product, by_sum = (gradient[:, None, None] for gradient in gradients)
        weight = counted[:, None].to(first.dtype)

        def of(needed: bool, other: Tensor) -> Tensor | None:
            return torch.addcmul(by_sum, by_product, other).mul_(weight) if needed else None

        return of(ctx.needs_input_grad[0], second), of(ctx.needs_input_grad[1], first), None
