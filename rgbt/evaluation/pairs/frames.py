"""Choose the pairs of frames of a split, and read first and second frames.

A second frame is a virtual view of the first (frames=virtual), a real one with known motion
(frames=next), or the next image of a video along an estimated flow (frames=video).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import zip_longest
from typing import Any, NamedTuple, cast

import torch

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.overrides import composing
from rgbt.data.loader_settings import LoaderSettings
from rgbt.data.loaders import eval_batches
from rgbt.data.mfnet import NextFrames
from rgbt.data.video import frames_before, frames_in_order
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.measure import NUM_PANELS, panel_names
from rgbt.geometry.optical_flow import FlowSource
from rgbt.geometry.warp import Warp
from rgbt.metrics.metric import Regions
from rgbt.metrics.pair_list import Frames, second_name
from rgbt.metrics.pairs import Protocol
from rgbt.requirements import check_requirements
from rgbt.transforms.views import ViewSets
from rgbt.types import Batch

# Usual source of the flow of videos, and least share of used pixels of a pair.
USUAL_FLOW: FlowSource = "both"
LEAST_USED = 0.1


def flow_source(frames: Frames, flow: str) -> FlowSource | None:
    """Return the images that the motion is estimated from; None: it is known exactly.

    `flow` is that of a command: "default", "exact", or a source. InputError: these second frames
    have no such motion.
    """
    if flow == "default":
        return USUAL_FLOW if frames == "video" else None
    fits = {"virtual": flow == "exact", "video": flow != "exact", "next": True}
    if not fits[frames]:
        raise InputError(f"flow={flow} is not possible: frames={frames}.")
    return None if flow == "exact" else cast(FlowSource, flow)


@dataclass(frozen=True, kw_only=True)
class FramePairs:
    """The pairs of frames of a split, of a network's session or for predictions of any method.

    Attributes:
        dataset, transform, loading, regions: how images are read, and their predictions counted.
        views: the sets of virtual views.
        split: of the data set.
        frames: what the second frames are.
        flow: images that the motion is estimated from (`flow_source`).
        least_used: share of the pixels below which a pair of a video is left out.

    Raises:
        InputError: no second frames, or views that paint a background that is no class.
    """

    dataset: LabelledDataset
    transform: Any
    loading: LoaderSettings
    regions: Regions
    views: ViewSets
    split: str
    frames: Frames = "virtual"
    flow: FlowSource | None = None
    least_used: float = LEAST_USED

    def __post_init__(self) -> None:
        if self.frames == "next":
            NextFrames(self.dataset)
        elif self.frames == "virtual":
            if not self.views.sets:
                raise InputError("consistency.sets is empty; set consistency=views.")
            check_requirements({"consistency": self.views, "dataset": self.dataset})

    @property
    def protocols(self) -> tuple[Protocol, ...]:
        """Return what is counted of each pair."""
        if self.frames == "virtual":
            return "aligned", "released"
        if self.frames == "video":
            return "flow", "triples"
        return ("next", "flow") if self.flow else ("next",)

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the pairs: of the first frames, in videos of the second ones."""
        if self.frames == "video":
            return tuple(frames_before(frames_in_order(self.dataset, self.split)))
        return self.dataset.names(self.split)

    @property
    def pictured(self) -> tuple[str, ...]:
        """Return the names of pairs in the picture; of videos, pairs spread over all of them."""
        if self.frames == "video":
            names = self.names
            return tuple(names[len(names) * at // NUM_PANELS] for at in range(NUM_PANELS))
        return panel_names(self.dataset, self.split)

    def mark(self, protocol: Protocol) -> str:
        """Return the suffix of partitions: "" for usual second frames, else digits of origin."""
        if protocol in ("aligned", "released"):
            return self.views.mark
        if (self.frames, self.flow, self.least_used) == ("video", USUAL_FLOW, LEAST_USED):
            return ""
        motion: object = self.least_used
        if self.frames == "next":
            motion = NextFrames(self.dataset).dataset.fingerprint()
        text = f"{self.flow} {motion}"
        return str(motion)[:6] if protocol == "next" else sha256(text.encode()).hexdigest()[:6]


def pairs_of(session: Session, split: str, **chosen: Any) -> FramePairs:
    """Return the pairs of the data set of `session`; `chosen` are frames, flow and least_used."""
    return FramePairs(
        dataset=session.dataset,
        transform=session.transform,
        loading=session.loading,
        regions=session.regions,
        views=session.consistency,
        split=split,
        **chosen,
    )


def composed_pairs(overrides: Sequence[str], split: str, **chosen: Any) -> FramePairs:
    """Return the pairs of a configuration without a network; images have the size of their files.

    `chosen` are frames, flow and least_used.
    """
    words = [*overrides, "transform=none"]
    with composing(words):
        config = compose(words)
        return FramePairs(
            dataset=build(config.dataset),
            transform=build(config.transform),
            # One at a time, because the images may have any sizes.
            loading=LoaderSettings(batch_size=1, eval_batch_size=1, num_workers=0),
            regions=build(config.metric),
            views=build(config.consistency),
            split=split,
            **chosen,
        )


class PairBatch(NamedTuple):
    """First and second frames of a batch of scenes, on the device.

    `names` are those of the second images, `number` is that of the set of views, from 0, and `warp`
    leads from the first to the second frames at the size of the images; None: these are real.
    """

    first: Batch
    second: Batch
    names: tuple[str, ...]
    number: int = 0
    warp: Warp | None = None


def frame_pairs(pairs: FramePairs, device: torch.device) -> Iterator[PairBatch]:
    """Yield every batch with its second frames, virtual ones of each set of views in turn."""
    if pairs.frames == "next":
        yield from _next_frames(pairs, device)
        return
    dataset, views = pairs.dataset, pairs.views
    listed = dataset.names(pairs.split)
    for batch in eval_batches(dataset, listed, pairs.transform, pairs.loading):
        moved = batch.to(device)
        # A name that the list holds twice has the views of its first position.
        indices = [listed.index(name) for name in batch.name]
        for number in range(len(views.sets)):
            angles = views.angles(number, indices).to(device)
            try:
                warp = views.view.warp(angles, (moved.rgb.shape[2], moved.rgb.shape[3]))
            except InputError as error:
                raise InputError(f"consistency.view, image '{batch.name[0]}': {error}") from error
            names = tuple(second_name(name, pairs.frames, number) for name in batch.name)
            yield PairBatch(moved, views.view.batch(moved, warp), names, number, warp)


def _next_frames(pairs: FramePairs, device: torch.device) -> Iterator[PairBatch]:
    dataset, after = pairs.dataset, NextFrames(pairs.dataset).dataset
    firsts, seconds = (
        eval_batches(images, images.names(pairs.split), pairs.transform, pairs.loading)
        for images in (dataset, after)
    )
    for first, second in zip_longest(firsts, seconds):
        if _shown(first) != _shown(second):
            raise InputError(
                f"both frames of a scene must be listed in {pairs.split}, readable and of one "
                f"size, but {dataset.root} has {_shown(first)} where {after.root} has "
                f"{_shown(second)}."
            )
        names = tuple(second_name(name, "next", 0) for name in first.name)
        yield PairBatch(first.to(device), second.to(device), names)


def _shown(batch: Batch | None) -> str:
    if batch is None:
        return "no further image"
    height, width = batch.label.shape[1:]
    return f"{', '.join(batch.name)} ({height} x {width} pixels)"
