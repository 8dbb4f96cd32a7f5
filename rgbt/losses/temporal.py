"""The loss of two frames of a scene (Temporal, Eq. 4).

The caller makes the second frame and warps the first prediction to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.geometry.halving import halved_label, halved_mean
from rgbt.losses.overlap import Form, con, con_acc, dice, single
from rgbt.ranges import NonNegative
from rgbt.requirements import Record, Requirement, record_of
from rgbt.types import IGNORE, Frame, Loss

OWN = ("dice", "con", "con_acc")


@dataclass(frozen=True, kw_only=True)
class TemporalLoss:
    """Segmentation of both frames, Dice of the first, and Dice or consistency of the second.

        L = seg_1 + alpha dice_1 + seg_2 + beta X

    Source: Temporal, Eq. (4) with X = con; Table I for the other X, and for what is left out.
    Released: alpha = beta = 1; X is dice, con or con_acc.

    Attributes:
        segmentation: seg, of each frame by itself. Paper and released: cross-entropy.
        alpha: finite, >= 0; with 0, the Dice loss of the first frame is not computed.
        beta: finite, >= 0; 0 if and only if `second` is "none".
        second: X: Dice loss of the second frame (`rgbt.losses.overlap`), or the first prediction
            against the second (there).
        form: of the Dice and the consistency losses, see there.

    Raises:
        InputError: a beta without a loss, a loss without a beta.
    """

    segmentation: Loss
    alpha: NonNegative
    beta: NonNegative
    second: Literal["none", "dice", "con", "con_acc"]
    form: Form

    def __post_init__(self) -> None:
        if self.second == "none" and self.beta:
            raise InputError(
                f"loss.beta={self.beta:g} has no effect with loss.second=none; set loss.beta=0, "
                "or choose loss.second=dice, con or con_acc."
            )
        if self.second != "none" and not self.beta:
            raise InputError(
                f"loss.second={self.second} has no effect with loss.beta=0; set loss.second=none, "
                "or a loss.beta above 0."
            )

    @property
    def record(self) -> Record:
        """The requirements of the loss of each frame, and a scheme of two frames.

        As released, Dice and con_acc leave out class 0.
        """
        own = [Requirement("scheme", "frames", 2)]
        if self.form == "released" and (self.alpha or self.second in ("dice", "con_acc")):
            own += [Requirement.of_background("loss.form=released")]
        compares = self.second in ("con", "con_acc")
        return Record(
            requires=(*record_of(self.segmentation).requires, *own),
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
        """The weighted parts, which add up to L.

        Args:
            first: frame 1: logits (B, K, H, W), label (B, H, W) int64 with 255 = ignore.
            second: frame 2, of the same sizes.
            warped: (B, K, H, W) probabilities of frame 1, warped to frame 2; only where the record
                says `reads_warped`. Whether a gradient goes through it is for the caller to decide.
                Or (B, K, ceil(H / 2), ceil(W / 2)): frame 2 is compared at half the size, by its
                scores averaged over 2x2 pixels, and by the label on which these pixels agree.
            valid: (B, H, W) bool, pixels of frame 2 that frame 1 shows; others do not count in
                "con" and "con_acc". Of the size of `warped`.
            generator: of the segmentation loss, frame 1 first.

        Returns:
            name -> () float32: the parts of the segmentation loss, passes summed, as <part>_1 and
            <part>_2 (seg_dice_1 where it has a dice of its own); "dice_1"; "dice_2", "con" or
            "con_acc".

        Raises:
            InputError: a network that `segmentation` cannot read.
            ValueError: shapes that do not fit; no `warped` where it is read.
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
            if warped is None:
                raise ValueError(f"warped: needed for the part {self.second}, got None.")
            half = warped.shape[2:] != second.logits.shape[2:]
            scores = single(second.logits)
            p = (halved_mean(scores) if half else scores).softmax(1)
            if self.second == "con":
                value = con(warped, p, valid, self.form)
            else:
                label = second.batch.label
                label = halved_label(label) if half else label
                value = con_acc(warped, p, label.where(valid, IGNORE), self.form)
            parts[self.second] = self.beta * value
        return parts

    def _dice(self, frame: Frame) -> Tensor:
        return dice(single(frame.logits).softmax(1), frame.batch.label, self.form)
