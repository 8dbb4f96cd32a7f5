"""How reliable an estimated flow is, for each pair of frames, and the file of these records."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rgbt.files.atomic import write_atomic
from rgbt.geometry.optical_flow import FrameFlow
from rgbt.tracking.csv_files import csv_text

SHOWN = 4
"""Most names in a sentence."""


@dataclass(frozen=True)
class FlowRecord:
    """One pair of frames.

    Attributes:
        name: of the second frame.
        used: share of the pixels whose flow is reliable, 0..1.
        displacement_px: median length of the flow at these pixels; NaN without any.
        end_point_error_px: mean distance from the exact flow at the used pixels that both frames
            show; NaN where it is not known.
        hidden: share of the used pixels that are hidden in the first frame; NaN as above.
    """

    name: str
    used: float
    displacement_px: float
    end_point_error_px: float = float("nan")
    hidden: float = float("nan")


def flow_record(name: str, found: FrameFlow, exact: NDArray[np.float32] | None) -> FlowRecord:
    """The record of a pair; `exact` flow (H, W, 2), NaN where a point is hidden, or None."""
    used = found.used
    if not used.any():
        return FlowRecord(name, 0.0, float("nan"))
    length = np.linalg.norm(found.flow[used], axis=-1)
    share, median = float(used.mean()), float(np.median(length))
    if exact is None:
        return FlowRecord(name, share, median)
    seen = np.isfinite(exact).all(-1)
    both = used & seen
    error = np.linalg.norm(found.flow[both] - exact[both], axis=-1)
    mean = float(error.mean()) if both.any() else float("nan")
    return FlowRecord(name, share, median, mean, float((used & ~seen).sum() / used.sum()))


def write_records(records: Sequence[FlowRecord], path: Path) -> None:
    """Write a CSV, one line per pair of frames; unknown values are empty."""
    header = tuple(field.name for field in fields(FlowRecord))
    rows = [
        tuple("" if value != value else value for value in astuple(record)) for record in records
    ]
    write_atomic(path, csv_text([header, *rows]).encode())


def flow_sentences(records: Sequence[FlowRecord], least_used: float) -> Iterator[str]:
    """What a user should know of the flow of all pairs."""
    counted = [each for each in records if each.used >= least_used]
    used = 100 * np.mean([each.used for each in counted])
    length = np.median([each.displacement_px for each in counted if each.used > 0] or [np.nan])
    yield (
        f"Flow of {len(counted)} pairs: {used:.1f} % of the pixels are used (both directions agree "
        f"there); the median displacement is {length:.1f} pixels."
    )
    left_out = [each for each in records if each.used < least_used]
    if left_out:
        names = ", ".join(each.name for each in left_out[:SHOWN])
        more = f" and {len(left_out) - SHOWN} more" if len(left_out) > SHOWN else ""
        yield (
            f"{len(left_out)} pairs are left out, because less than {100 * least_used:g} % of "
            f"their pixels could be used; second frames: {names}{more}."
        )
    errors = [each.end_point_error_px for each in counted if each.end_point_error_px >= 0]
    if errors:
        hidden = 100 * np.nanmean([each.hidden for each in counted])
        yield (
            f"Distance from the exact flow: {np.mean(errors):.2f} pixels on average; {hidden:.1f} "
            "% of the used pixels are hidden in the first frame."
        )
