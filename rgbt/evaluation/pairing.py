"""What the second frames of pairs are, how points are followed, and what is counted of them."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.next_frames import NextFrames
from rgbt.data.sequences import FramesInOrder
from rgbt.evaluation.flow_record import FlowRecord
from rgbt.evaluation.prediction import EvaluationData
from rgbt.evaluation.segmentation import NUM_PANELS, panel_names
from rgbt.geometry.optical_flow import FlowSource
from rgbt.metrics.pair_list import Frames
from rgbt.metrics.pairs import Protocol, partition_name

FlowChoice = Literal["default", "exact"] | FlowSource

USUAL_FLOW: FlowSource = "both"
"""Source of the flow of videos, unless another one is requested."""

LEAST_USED = 0.1
"""Usual least share of used pixels of a pair."""

PROTOCOLS: dict[Frames, tuple[Protocol, ...]] = {
    "virtual": ("aligned", "released"),
    "next": ("next",),
    "video": ("flow", "triples"),
}
"""Protocols of counting for each kind of second frame."""


@dataclass(frozen=True)
class Pairing:
    """The pairs of frames that are counted.

    Attributes:
        frames: what the second frames are.
        flow: images that the motion is estimated from; None: it is known exactly.
        least_used: share of the pixels below which a pair of a video is left out.
    """

    frames: Frames
    flow: FlowSource | None = None
    least_used: float = LEAST_USED

    @classmethod
    def of(
        cls, frames: Frames, flow: FlowChoice = "default", least_used: float = LEAST_USED
    ) -> Pairing:
        """From the options of a command, of which `flow` may be "default".

        Raises:
            InputError: a flow that such frames do not have.
        """
        if frames != "video" and least_used != LEAST_USED:
            raise InputError("'least_used' has an effect on frames=video only; omit it.")
        if frames == "video" and flow == "exact":
            raise InputError(
                "flow=exact: the exact flow of a video is not known; choose flow=rgb, thermal or "
                "both, or frames=next for frames with known motion."
            )
        if frames == "virtual" and flow != "default":
            raise InputError(
                "'flow' has no effect on virtual views, whose motion is known; omit it, or choose "
                "frames=next or frames=video."
            )
        if flow == "default" or flow == "exact":
            return cls(frames, USUAL_FLOW if frames == "video" else None, least_used)
        return cls(frames, flow, least_used)

    @property
    def protocols(self) -> tuple[Protocol, ...]:
        """What is counted of each pair."""
        known = PROTOCOLS[self.frames]
        return (*known, "flow") if self.frames == "next" and self.flow else known

    @property
    def drawn(self) -> Protocol:
        """The protocol of the picture."""
        return "flow" if self.flow else self.protocols[0]

    def images(self, data: EvaluationData, split: str) -> tuple[str, ...]:
        """Names of all frames that are read, in order."""
        if self.frames == "video":
            return FramesInOrder(data.dataset, split).names(split)
        return data.dataset.names(split)

    def pictured(self, data: EvaluationData, split: str) -> tuple[str, ...]:
        """Names of the pairs in the picture; of videos, pairs spread over all of them."""
        if self.frames != "video":
            return panel_names(data.dataset, split)
        pairs = tuple(FramesInOrder(data.dataset, split).pairs)
        return tuple(pairs[len(pairs) * at // NUM_PANELS] for at in range(NUM_PANELS))

    def number(self, data: EvaluationData, split: str) -> int:
        """Number of pairs, or of images where each has several views."""
        if self.frames == "video":
            return len(FramesInOrder(data.dataset, split).pairs)
        return len(data.dataset.names(split))

    def mark(self, data: EvaluationData, protocol: Protocol) -> str:
        """Suffix of partitions and files: "" for the usual second frames, else six digits.

        For real second frames it depends on lists and files, so that another motion differs.
        """
        if protocol in ("aligned", "released"):
            return data.consistency.mark
        if self.frames == "video":
            usual = (self.flow, self.least_used) == (USUAL_FLOW, LEAST_USED)
            return "" if usual else _digest(f"{self.flow} {self.least_used}")
        motion = NextFrames(data.dataset).dataset.fingerprint()
        return motion[:6] if protocol == "next" else _digest(f"{self.flow} {motion}")

    def file_mark(self, data: EvaluationData, protocol: Protocol) -> str:
        """`mark` in the name of a file; counts along an exact flow have one name."""
        return "" if protocol == "next" else self.mark(data, protocol)

    def partition(self, data: EvaluationData, protocol: Protocol) -> Callable[[int], str]:
        """Number of sets of views -> the name of the partition."""
        return partial(partition_name, protocol, views=self.mark(data, protocol))

    def check_used(self, records: Sequence[FlowRecord]) -> None:
        """Refuse videos of which no pair can be used.

        Raises:
            InputError: the flow is too unreliable everywhere.
        """
        if self.frames == "video" and all(each.used < self.least_used for each in records):
            most = max((each.used for each in records), default=0.0)
            raise InputError(
                f"none of {len(records)} pairs of frames has a reliable flow at "
                f"{100 * self.least_used:g} % of its pixels (at most {100 * most:.1f} %); the "
                "frames may be too far apart. Set least_used=... to count them anyway."
            )


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:6]
