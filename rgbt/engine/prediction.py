"""Settings of a prediction: mirrored images, sliding windows, scales, enlargement of scores."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, Len

from rgbt.ranges import Size
from rgbt.requirements import Record, Requirement

Scales = Annotated[tuple[Annotated[float, Interval(ge=0.1, le=4)], ...], Len(1, 16)]
"""Factors of the size of an image."""


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """How an image is predicted in evaluation, and the size at which its classes are counted.

    Source: thesis (J. Sun), its code, for everything named "released"; semseg (PSPNet), its test
    script, for windows, scales and mirrored images.

    Attributes:
        align_corners: whether class scores are enlarged to the label with corners aligned.
            Released (networks with two heads): true.
        mirrored: whether class probabilities are averaged with those of the mirrored image.
            Released (maximum squares) and semseg: true.
        scales: sizes of the image relative to that of the transform; the probabilities of all are
            enlarged to the label and averaged. semseg: (1.0,).
        window_hw: rows and columns of sliding windows in pixels, at most those of the image; null
            predicts the whole image at once. semseg: the size of its training crops.
        window_stride: step between windows as a share of their side, in (0, 1]. semseg: 2/3.
        enlarged: what is enlarged to the size of the label: "scores", or "released": the class
            numbers, bilinearly and rounded, so that a border may get a third class (maximum
            squares).
        counted: where classes are compared with labels: at the size of the "label" file; or at that
            of the "image" that the network sees, with the label made smaller by `label_resize`.
            Released (port of HeatNet): "image".
        label_resize: "nearest" (HeatNet's release) or "bilinear" (thesis' port, mixes class
            numbers); used with counted="image".
    """

    align_corners: bool = False
    mirrored: bool = False
    scales: Scales = (1.0,)
    window_hw: Size | None = None
    window_stride: Annotated[float, Interval(ge=0.05, le=1)] = 2 / 3
    enlarged: Literal["scores", "released"] = "scores"
    counted: Literal["label", "image"] = "label"
    label_resize: Literal["nearest", "bilinear"] = "nearest"

    @property
    def averages(self) -> bool:
        """Whether a prediction is the mean of the probabilities of several passes."""
        return self.mirrored or self.window_hw is not None or self.scales != (1.0,)

    @property
    def record(self) -> Record:
        """Class scores where probabilities are averaged."""
        keys = {"mirrored": self.mirrored, "window_hw": self.window_hw, "scales": self.averages}
        cause = f"prediction.{next((key for key, value in keys.items() if value), '')}"
        needed = (Requirement("model", "outputs", "scores", cause),) if self.averages else ()
        return Record(requires=needed)


WHOLE = Prediction()
"""One pass over the whole image; classes are counted at the size of the label."""
