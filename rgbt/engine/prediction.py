"""Settings of a prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, Len

from rgbt.ranges import Size
from rgbt.requirements import Record, Requirement

Scale = Annotated[float, Interval(ge=0.1, le=4)]


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Says how an image is predicted in evaluation; conf/prediction/whole.yaml explains each key.

    Source: thesis (J. Sun), its code, for everything named "released"; semseg (PSPNet), its test
    script, for windows, scales and mirrored images.
    """

    align_corners: bool = False
    mirrored: bool = False
    scales: Annotated[tuple[Scale, ...], Len(1, 16)] = (1.0,)
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
        """Require class scores where probabilities are averaged."""
        if not self.averages:
            return Record()
        cause = "mirrored" if self.mirrored else "window_hw" if self.window_hw else "scales"
        needed = Requirement("model", "outputs", "scores", f"prediction.{cause}")
        return Record(requires=(needed,))


WHOLE = Prediction()
