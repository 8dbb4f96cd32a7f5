"""Make an example of a sample and a view.

Every transform has `train(sample, rng)`, for which all draws come from `rng`, and `test(sample)`;
of a sample without a label, all pixels are ignored.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from rgbt.transforms.joint import View, short_edge_hw, whole_view
from rgbt.types import IGNORE, Example, Sample

ImageResize = Callable[[View, NDArray[np.uint8], DTypeLike], NDArray[Any]]
"""(view, image, dtype) -> the view of the image, of that dtype; such as `View.bilinear`."""

LabelResize = Callable[[View, NDArray[np.uint8]], NDArray[np.uint8]]
"""(view, label) -> the view of the label; such as `View.nearest`."""


def image_hw(sample: Sample) -> tuple[int, int]:
    """Size of a sample's images in pixels."""
    height, width = sample.thermal.shape
    return height, width


def viewed(  # noqa: PLR0913 - three of one kind
    sample: Sample,
    view: View,
    dtype: DTypeLike,
    *,
    track_position: bool,
    of_image: ImageResize = View.bilinear,
    of_label: LabelResize = View.nearest,
) -> Example:
    """RGB, thermal, label and confidence of a sample through one view; no label: all ignored.

    Args:
        sample: as it lies on disk.
        view: of images of its size.
        dtype: of the images: uint8, rounded, or float32.
        track_position: whether the example carries the map of source positions.
        of_image: how RGB and thermal are resized.
        of_label: how the label is resized.
    """
    return Example(
        rgb=of_image(view, sample.rgb, dtype),
        thermal=of_image(view, sample.thermal, dtype),
        label=of_label(view, _label(sample)),
        centre_yx=view.centre_yx(),
        position=view.position() if track_position else None,
        original_hw=view.source_hw,
        name=sample.name,
        confidence=None if sample.confidence is None else view.nearest(sample.confidence),
    )


def evaluated(
    sample: Sample,
    short_edge: int | None,
    *,
    track_position: bool,
    max_size: int | None = None,
    dtype: DTypeLike = np.uint8,
    of_image: ImageResize = View.bilinear,
) -> Example:
    """The whole images of a sample, resized on request; the label as it is.

    Args:
        sample: as it lies on disk.
        short_edge: of the images in pixels; None keeps their size.
        track_position: see `viewed`.
        max_size: limit of their long edge in pixels (see `short_edge_hw`).
        dtype: see `viewed`.
        of_image: how RGB and thermal are resized.
    """
    source_hw = image_hw(sample)
    resized_hw = source_hw
    if short_edge is not None:
        resized_hw = short_edge_hw(source_hw, short_edge, max_size)
    view = whole_view(source_hw, resized_hw)
    example = viewed(sample, view, dtype, track_position=track_position, of_image=of_image)
    return replace(example, label=_label(sample), confidence=sample.confidence)


def _label(sample: Sample) -> NDArray[np.uint8]:
    if sample.label is None:
        return np.full(image_hw(sample), IGNORE, np.uint8)
    return sample.label
