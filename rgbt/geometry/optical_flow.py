"""Estimate where the points of a frame lie in the frame before it, without training.

Flows are (H, W, 2) float32: for every pixel of one frame, how many (rows, columns) further the same
point lies in the other. Pixels count whose flows in both directions agree: others are hidden.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError

# Images that the flow is estimated from; "both": at each pixel, the one whose flows agree best.
FlowSource = Literal["rgb", "thermal", "both"]

# Least height and width of frames in pixels: two patches of the estimation.
SMALLEST = 16

# Limit of the squared disagreement of two flows: 0.01 (|w|^2 + |w'|^2) + 0.5 square pixels.
RELATIVE, ABSOLUTE = 0.01, 0.5

Gray = NDArray[np.uint8]
Flow = NDArray[np.float32]


class FrameFlow(NamedTuple):
    """Holds the estimated motion between two frames, for every pixel of the second one.

    `flow` leads to the first frame; `used` (H, W) is whether the flows of both directions agree and
    the point is inside the first frame.
    """

    flow: Flow
    used: NDArray[np.bool_]

    def source(self) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return rows and columns (H, W) of the nearest pixels of the first frame, or -1."""
        height, width = self.used.shape
        rows, columns = np.indices(self.used.shape) + np.moveaxis(self.flow, -1, 0)
        rows = np.rint(rows).astype(np.int64).clip(0, height - 1)
        columns = np.rint(columns).astype(np.int64).clip(0, width - 1)
        return np.where(self.used, rows, -1), np.where(self.used, columns, -1)


def gray_of(rgb: NDArray[np.uint8]) -> Gray:
    """Convert RGB (H, W, 3) to grey levels (H, W)."""
    return np.asarray(cv2.cvtColor(np.ascontiguousarray(rgb), cv2.COLOR_RGB2GRAY), np.uint8)


def frame_flow(
    first: dict[str, Gray], second: dict[str, Gray], source: FlowSource = "both"
) -> FrameFlow:
    """Estimate the motion between two frames; InputError for sizes that differ or are too small.

    `first` and `second` are grey levels (H, W) by the name of the image, "rgb" and "thermal".
    """
    names = ("rgb", "thermal") if source == "both" else (source,)
    found = []
    for name in names:
        flow = estimate(second[name], first[name])
        found.append((flow, disagreement(flow, estimate(first[name], second[name]))))
    flow, error = found[0]
    for other, other_error in found[1:]:
        better = other_error < error
        flow, error = np.where(better[..., None], other, flow), np.where(better, other_error, error)
    return FrameFlow(flow, error <= 1)


def estimate(start: Gray, end: Gray) -> Flow:
    """Estimate flow from `start` (H, W) to `end` by dense inverse search; errors as `frame_flow`.

    Source: Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016, in OpenCV
    with its preset "medium".
    """
    if start.shape != end.shape or min(start.shape) < SMALLEST:
        sizes = [" x ".join(map(str, image.shape)) for image in (start, end)]
        raise InputError(f"flow: expected one size of at least {SMALLEST} pixels, got {sizes}.")
    # OpenCV's type stubs lack this function.
    search = vars(cv2)["DISOpticalFlow_create"](cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    return np.ascontiguousarray(search.calc(start, end, None)[..., ::-1], dtype=np.float32)


def disagreement(flow: Flow, back: Flow) -> NDArray[np.float32]:
    """Compute how far `back` misses the start of `flow`, by the limit: (H, W), inf outside.

        |w(x) + w'(x + w(x))|^2 / (0.01 (|w|^2 + |w'|^2) + 0.5)

    Source: Sundaram, Brox and Keutzer, "Dense Point Trajectories by GPU-accelerated Large
    Displacement Optical Flow", ECCV 2010, Eq. 5.
    """
    height, width = flow.shape[:2]
    rows, columns = np.indices((height, width), np.float32)
    rows, columns = rows + flow[..., 0], columns + flow[..., 1]
    inside = (rows >= -0.5) & (rows <= height - 0.5) & (columns >= -0.5) & (columns <= width - 0.5)
    there = cv2.remap(back, columns, rows, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    missed = np.square(flow + there).sum(-1)
    limit = RELATIVE * (np.square(flow).sum(-1) + np.square(there).sum(-1)) + ABSOLUTE
    return np.where(inside, missed / limit, np.inf).astype(np.float32)
