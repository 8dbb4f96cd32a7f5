"""What the second frames of pairs are, and how points are followed from the first to the second.

A second frame is a virtual view of the first (frames=virtual), a real one with known motion
(frames=next), or the next image of a video along an estimated flow (frames=video).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from itertools import zip_longest
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.config.component import build
from rgbt.config.compose import compose
from rgbt.config.overrides import composing
from rgbt.data.loader_settings import LoaderSettings
from rgbt.data.loaders import eval_batches
from rgbt.data.mfnet import NextFrames
from rgbt.data.video import FramesInOrder
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.measure import NUM_PANELS, panel_names
from rgbt.geometry.optical_flow import FlowSource, FrameFlow, frame_flow, gray_of
from rgbt.geometry.warp import Warp
from rgbt.metrics.metric import Regions
from rgbt.metrics.pair_list import Frames, second_name
from rgbt.metrics.pairs import Protocol
from rgbt.requirements import check_requirements
from rgbt.transforms.views import ViewSets
from rgbt.types import IGNORE, Batch

USUAL_FLOW: FlowSource = "both"
# Usual source of the flow of videos, and least share of used pixels of a pair.
LEAST_USED = 0.1

# Class maps (B, H', W') uint8, at the size of the labels, of frames and their names.
Predict = Callable[[Batch, Sequence[str]], Tensor]


@dataclass(frozen=True)
class PairSource:
    """The images of pairs, without a network."""

    dataset: LabelledDataset
    transform: Any
    loading: LoaderSettings
    regions: Regions
    consistency: ViewSets

    @classmethod
    def compose(cls, overrides: Sequence[str]) -> PairSource:
        """Compose overrides of the configuration; images have the size of their files."""
        words = [*overrides, "transform=none"]
        with composing(words):
            config = compose(words)
            return cls(
                dataset=build(config.dataset),
                transform=build(config.transform),
                # One at a time, because the images may have any sizes.
                loading=LoaderSettings(batch_size=1, eval_batch_size=1, num_workers=0),
                regions=build(config.metric),
                consistency=build(config.consistency),
            )


# Images and how they are counted: with a network, or for predictions of any method.
EvaluationData: TypeAlias = Session | PairSource


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
    def of(cls, frames: Frames, flow: str, least_used: float) -> Pairing:
        """The source of pairs that a command's options name; `flow` may be "default" or "exact"."""
        if flow == "default":
            return cls(frames, USUAL_FLOW if frames == "video" else None, least_used)
        return cls(frames, None if flow == "exact" else cast(FlowSource, flow), least_used)

    def __post_init__(self) -> None:
        if self.frames != "next" and (self.flow is None) != (self.frames == "virtual"):
            raise InputError(f"flow={self.flow or 'exact'} is not possible: frames={self.frames}.")

    @property
    def protocols(self) -> tuple[Protocol, ...]:
        """What is counted of each pair."""
        if self.frames == "virtual":
            return "aligned", "released"
        if self.frames == "video":
            return "flow", "triples"
        return ("next", "flow") if self.flow else ("next",)

    def check(self, data: EvaluationData) -> None:
        """InputError: no second frames, or views that paint a background that is no class."""
        if self.frames == "next":
            NextFrames(data.dataset)
        elif self.frames == "virtual":
            if not data.consistency.sets:
                raise InputError("consistency.sets is empty; set consistency=views.")
            check_requirements({"consistency": data.consistency, "dataset": data.dataset})

    def names(self, data: EvaluationData, split: str) -> tuple[str, ...]:
        """Names of the pairs: of the first frames, in videos of the second ones."""
        if self.frames == "video":
            return tuple(FramesInOrder(data.dataset, split).pairs)
        return data.dataset.names(split)

    def pictured(self, data: EvaluationData, split: str) -> tuple[str, ...]:
        """Names of the pairs in the picture; of videos, pairs spread over all of them."""
        names = self.names(data, split)
        if self.frames == "video":
            return tuple(names[len(names) * at // NUM_PANELS] for at in range(NUM_PANELS))
        return panel_names(data.dataset, split)

    def mark(self, data: EvaluationData, protocol: Protocol) -> str:
        """Suffix of partitions: "" for the usual second frames, else digits of their origin."""
        if protocol in ("aligned", "released"):
            return data.consistency.mark
        if (self.frames, self.flow, self.least_used) == ("video", USUAL_FLOW, LEAST_USED):
            return ""
        motion: object = self.least_used
        if self.frames == "next":
            motion = NextFrames(data.dataset).dataset.fingerprint()
        text = f"{self.flow} {motion}"
        return str(motion)[:6] if protocol == "next" else sha256(text.encode()).hexdigest()[:6]


class FramePairs(NamedTuple):
    """First and second frames of a batch of scenes, on the device.

    `names` are those of the second images, `number` is that of the set of views, from 0, and `warp`
    leads from the first to the second frames at the size of the images; None: these are real.
    """

    first: Batch
    second: Batch
    names: tuple[str, ...]
    number: int = 0
    warp: Warp | None = None


def frame_pairs(
    data: EvaluationData, split: str, frames: Frames, device: torch.device
) -> Iterator[FramePairs]:
    """Every batch of a split with its second frames, virtual ones of each set of views in turn."""
    if frames == "next":
        yield from _next_frames(data, split, device)
        return
    listed, views = data.dataset.names(split), data.consistency.view
    for batch in eval_batches(data.dataset, split, data.transform, data.loading):
        moved = batch.to(device)
        # A name that the list holds twice has the views of its first position.
        indices = [listed.index(name) for name in batch.name]
        for number in range(len(data.consistency.sets)):
            angles = data.consistency.angles(number, indices).to(device)
            try:
                warp = views.warp(angles, (moved.rgb.shape[2], moved.rgb.shape[3]))
            except InputError as error:
                raise InputError(f"consistency.view, image '{batch.name[0]}': {error}") from error
            names = tuple(second_name(name, frames, number) for name in batch.name)
            yield FramePairs(moved, views.batch(moved, warp), names, number, warp)


def _next_frames(data: EvaluationData, split: str, device: torch.device) -> Iterator[FramePairs]:
    after = NextFrames(data.dataset).dataset
    datasets = (data.dataset, after)
    loaders = [eval_batches(each, split, data.transform, data.loading) for each in datasets]
    for batch, later in zip_longest(*loaders):
        shown = [_shown(each) for each in (batch, later)]
        if shown[0] != shown[1]:
            raise InputError(
                f"both frames of a scene must be listed in {split}, readable and of one size, but "
                f"{data.dataset.root} has {shown[0]} where {after.root} has {shown[1]}."
            )
        names = tuple(second_name(name, "next", 0) for name in batch.name)
        yield FramePairs(batch.to(device), later.to(device), names)


def _shown(batch: Batch | None) -> str:
    if batch is None:
        return "no further image"
    height, width = batch.label.shape[1:]
    return f"{', '.join(batch.name)} ({height} x {width} pixels)"


class Compared(NamedTuple):
    """Class maps (B, H', W') as one protocol compares them, and `valid` pixels; None: all."""

    first: Tensor
    second: Tensor
    label: Tensor
    valid: Tensor | None


class FlowRecord(NamedTuple):
    """How reliable the estimated flow of one pair of frames is; NaN where it is not known.

    Attributes:
        name: of the second frame.
        used: share of the pixels whose flow is reliable, 0..1.
        displacement_px: median length of the flow at these pixels.
        end_point_error_px: mean distance from the exact flow at the used pixels in both frames.
        hidden: share of the used pixels that are hidden in the first frame.
    """

    name: str
    used: float
    displacement_px: float = float("nan")
    end_point_error_px: float = float("nan")
    hidden: float = float("nan")


class Scenes(NamedTuple):
    """A batch of B scenes with both predictions.

    Attributes:
        compared: class maps (B, H', W') by protocol; {} if too few pixels of a pair are used.
        images: (B, 3, H, W) float in [0, 1], RGB of both frames.
        first: (B, H', W') prediction of the first frame, in its own pixels.
        number: of the set of views, from 0.
        flows: estimated motion of each scene; () where none is estimated, as `records`.
    """

    names: tuple[str, ...]
    compared: dict[Protocol, Compared]
    images: tuple[Tensor, Tensor]
    first: Tensor
    number: int = 0
    flows: tuple[FrameFlow, ...] = ()
    records: tuple[FlowRecord, ...] = ()


def scenes(
    data: EvaluationData, predict: Predict, split: str, pairing: Pairing, device: torch.device
) -> Iterator[Scenes]:
    """Both predictions of every scene of a split, compared point by point; see `frame_pairs`."""
    kinds = {"virtual": _virtual_scenes, "next": _next_scenes, "video": _video_scenes}
    return kinds[pairing.frames](data, predict, split, pairing, device)


def _virtual_scenes(
    data: EvaluationData, predict: Predict, split: str, pairing: Pairing, device: torch.device
) -> Iterator[Scenes]:
    first = torch.empty(0)
    for pairs in frame_pairs(data, split, pairing.frames, device):
        assert pairs.warp is not None, "views are warped"
        if pairs.number == 0:
            first = predict(pairs.first, pairs.first.name)
        second, label = predict(pairs.second, pairs.names), pairs.second.label
        at_label = pairs.warp.resized((first.shape[1], first.shape[2]))
        valid = at_label.inside() & (label != IGNORE)
        compared: dict[Protocol, Compared] = {
            "aligned": Compared(at_label.nearest(first, 0), second, label, valid),
            # The release does this: the first prediction stays where it is, and every pixel counts.
            "released": Compared(first, second, label, None),
        }
        images = (pairs.first.rgb, pairs.second.rgb)
        yield Scenes(pairs.first.name, compared, images, first, pairs.number)


def _next_scenes(
    data: EvaluationData, predict: Predict, split: str, pairing: Pairing, device: torch.device
) -> Iterator[Scenes]:
    """Along the exact flow, and if one is requested also along an estimated flow."""
    after = NextFrames(data.dataset)
    for pairs in frame_pairs(data, split, pairing.frames, device):
        names, label = pairs.first.name, pairs.second.label.cpu()
        first = predict(pairs.first, names).cpu()
        second = predict(pairs.second, pairs.names).cpu()
        image_hw = (first.shape[1], first.shape[2])
        sources: dict[Protocol, list[NDArray[np.int64]]] = {}
        sources["next"] = [np.stack(after.source(name, image_hw)) for name in names]
        flows, records = [], []
        if pairing.flow is not None:
            for name in names:
                images = [_images_of(each, name) for each in (data.dataset, after.dataset)]
                flows.append(frame_flow(images[0], images[1], pairing.flow))
                records.append(_record(name, flows[-1], after.flow(name, image_hw)))
            sources["flow"] = [np.stack(each.source()) for each in flows]
        compared: dict[Protocol, Compared] = {}
        for protocol in pairing.protocols:
            followed, seen = _followed(first, sources[protocol])
            compared[protocol] = Compared(followed, second, label, seen & (label != IGNORE))
        shown = (pairs.first.rgb, pairs.second.rgb)
        yield Scenes(names, compared, shown, first, 0, tuple(flows), tuple(records))


def _video_scenes(
    data: EvaluationData, predict: Predict, split: str, pairing: Pairing, device: torch.device
) -> Iterator[Scenes]:
    """Every pair of consecutive frames; one with too few used pixels begins triples anew."""
    assert pairing.flow is not None, "videos have an estimated flow"
    frames = FramesInOrder(data.dataset, split)
    previous_of = frames.pairs
    before: tuple[Batch, Tensor] | None = None
    # Prediction of the frame before `before`, followed to it, and where that one shows it.
    moved: tuple[Tensor, Tensor] | None = None
    for frame, second in _predicted(data, frames, predict, split, device):
        name = frame.name[0]
        earlier, before = before, (frame, second)
        if earlier is None or earlier[0].name[0] != previous_of.get(name):
            moved = None
            continue
        first_frame, first = earlier
        images = [_images_of(data.dataset, each) for each in (previous_of[name], name)]
        flow = frame_flow(images[0], images[1], pairing.flow)
        found = Scenes(
            (name,), {}, (first_frame.rgb, frame.rgb), first, 0, (flow,), (_record(name, flow),)
        )
        if found.records[0].used < pairing.least_used:
            moved = None
            yield found
            continue
        source = [np.stack(flow.source())]
        followed, seen = _followed(first, source)
        found.compared["flow"] = Compared(followed, second, frame.label.cpu(), seen)
        if moved is not None:
            # What the second frame shows of the first one is moved on to the third.
            earliest, reached = (_followed(each, source)[0] for each in moved)
            found.compared["triples"] = Compared(followed, second, earliest, seen & reached)
        moved = followed, seen
        yield found


def _predicted(
    data: EvaluationData, frames: FramesInOrder, predict: Predict, split: str, device: torch.device
) -> Iterator[tuple[Batch, Tensor]]:
    """Every frame alone, in order, with its prediction (1, H', W')."""
    for loaded in eval_batches(frames, split, data.transform, data.loading):
        batch = loaded.to(device)
        predictions = predict(batch, batch.name).cpu()
        for at, name in enumerate(batch.name):
            maps = {key: getattr(batch, key)[at : at + 1] for key in ("rgb", "thermal", "label")}
            yield replace(batch, name=(name,), **maps), predictions[at : at + 1]


def _followed(first: Tensor, sources: list[NDArray[np.int64]]) -> tuple[Tensor, Tensor]:
    """Maps (B, H, W) at the pixels of the second frame, and where these are in the first."""
    height, width = first.shape[1:]
    rows, columns = torch.from_numpy(np.stack(sources, 1))
    seen = rows >= 0
    flat = (rows * width + columns).clamp(min=0).flatten(1)
    return first.flatten(1).gather(1, flat).view_as(first), seen


def _images_of(dataset: LabelledDataset, name: str) -> dict[str, NDArray[np.uint8]]:
    """Grey levels (H, W) of RGB and thermal of a frame, as stored: the same for every network."""
    sample = dataset.read(name)
    return {"rgb": gray_of(sample.rgb), "thermal": sample.thermal}


def _record(name: str, found: FrameFlow, exact: NDArray[np.float32] | None = None) -> FlowRecord:
    """The record of a pair; `exact` flow (H, W, 2), NaN where a point is hidden, or None."""
    used = found.used
    if not used.any():
        return FlowRecord(name, 0.0)
    median = float(np.median(np.linalg.norm(found.flow[used], axis=-1)))
    record = FlowRecord(name, float(used.mean()), median)
    if exact is None:
        return record
    seen = np.isfinite(exact).all(-1)
    both = used & seen
    error = np.linalg.norm(found.flow[both] - exact[both], axis=-1)
    mean = float(error.mean()) if both.any() else float("nan")
    hidden = float((used & ~seen).sum() / used.sum())
    return record._replace(end_point_error_px=mean, hidden=hidden)
