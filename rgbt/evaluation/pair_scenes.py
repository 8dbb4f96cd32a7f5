"""Both predictions of every scene of a split, compared point by point.

The second frame is a virtual view of the first (frames=virtual), a true one with known motion
(frames=next), or the next image of a video (frames=video).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.data.next_frames import NextFrames
from rgbt.data.sequences import FramesInOrder
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.flow_record import FlowRecord, flow_record
from rgbt.evaluation.pair_frames import next_frames, virtual_frames
from rgbt.evaluation.prediction import EvaluationData
from rgbt.geometry.optical_flow import FlowSource, FrameFlow, frame_flow, gray_of
from rgbt.metrics.pairs import Protocol as PairProtocol
from rgbt.types import IGNORE, Batch


class Compared(NamedTuple):
    """Class maps (B, H', W') of scenes as one protocol compares them, and labels of the second.

    Attributes:
        valid: pixels that count; None: all.
    """

    first: Tensor
    second: Tensor
    label: Tensor
    valid: Tensor | None


class Scenes(NamedTuple):
    """A batch of scenes with both predictions.

    Attributes:
        names: of the B scenes.
        compared: class maps (B, H', W') by protocol.
        images: (B, 3, H, W) float in [0, 1], RGB of both frames.
        first: (B, H', W') prediction of the first frame, in its own pixels.
        number: of the set of views, from 0.
        flows: estimated motion of each scene; () where none is estimated.
        records: how reliable each of these is.
    """

    names: tuple[str, ...]
    compared: dict[PairProtocol, Compared]
    images: tuple[Tensor, Tensor]
    first: Tensor
    number: int = 0
    flows: tuple[FrameFlow, ...] = ()
    records: tuple[FlowRecord, ...] = ()


class PairPredictor(Protocol):
    """Class maps (B, H', W') uint8 of both frames, at the size of their labels."""

    @property
    def device(self) -> torch.device:
        """Where batches are expected."""

    def first(self, batch: Batch) -> Tensor:
        """Of first frames, and of all frames of a video."""

    def second(self, batch: Batch, number: int) -> Tensor:
        """Of second frames; `number` of the set of views, from 0."""


def virtual_scenes(data: EvaluationData, predictor: PairPredictor, split: str) -> Iterator[Scenes]:
    """The scenes of a split with each set of views in turn."""
    first = torch.empty(0)
    for frames in virtual_frames(data, split, predictor.device):
        if frames.number == 0:
            first = predictor.first(frames.batch)
        second = predictor.second(frames.second, frames.number)
        label = frames.second.label
        at_label = frames.warp.resized((first.shape[1], first.shape[2]))
        valid = at_label.inside() & (label != IGNORE)
        compared: dict[PairProtocol, Compared] = {
            "aligned": Compared(at_label.nearest(first, 0), second, label, valid),
            # As released: the first prediction stays where it is, and every pixel counts.
            "released": Compared(first, second, label, None),
        }
        images = (frames.batch.rgb, frames.second.rgb)
        yield Scenes(frames.batch.name, compared, images, first, frames.number)


def next_scenes(
    data: EvaluationData, predictor: PairPredictor, split: str, flow: FlowSource | None
) -> Iterator[Scenes]:
    """The scenes of a split and their true second frames, along the exact flow.

    With `flow`, also along the flow that is estimated from these images.
    """
    after = NextFrames(data.dataset)
    for batch, later in next_frames(data, after, split, predictor.device):
        first, second = predictor.first(batch).cpu(), predictor.second(later, 0).cpu()
        image_hw = (first.shape[1], first.shape[2])
        sources = [np.stack(after.source(name, image_hw)) for name in batch.name]
        label = later.label.cpu()
        followed, seen = _followed(first, sources)
        compared: dict[PairProtocol, Compared] = {
            "next": Compared(followed, second, label, seen & (label != IGNORE))
        }
        scenes = Scenes(batch.name, compared, (batch.rgb, later.rgb), first)
        if flow is not None:
            flows = tuple(
                frame_flow(images_of(data.dataset, name), images_of(after.dataset, name), flow)
                for name in batch.name
            )
            followed, seen = _followed(first, [np.stack(each.source()) for each in flows])
            compared["flow"] = Compared(followed, second, label, seen & (label != IGNORE))
            records = tuple(
                flow_record(name, each, after.flow(name, image_hw))
                for name, each in zip(batch.name, flows, strict=True)
            )
            scenes = scenes._replace(flows=flows, records=records)
        yield scenes


class VideoFrame(NamedTuple):
    """One frame of a video.

    Attributes:
        batch: its images and label, B = 1, on the device of the network.
        prediction: (1, H', W') its predicted classes.
        flow: its motion from the frame before it; None: there is no frame before it.
    """

    batch: Batch
    prediction: Tensor
    flow: FrameFlow | None


def video_scenes(
    data: EvaluationData, predictor: PairPredictor, split: str, flow: FlowSource, least: float
) -> Iterator[Scenes]:
    """Every pair of consecutive frames of a split, by the name of the second one.

    Args:
        data: its data set has the frames.
        predictor: of single frames.
        split: of the data set.
        flow: images that the motion is estimated from.
        least: share of the pixels of a frame that must be used; pairs with fewer are left out, and
            have a record alone.

    Raises:
        InputError: no consecutive frames, or frames of a video that differ in size.
    """
    frames = FramesInOrder(data.dataset, split)
    previous_of = frames.pairs
    before: list[VideoFrame] = []
    for frame in _predicted(data, frames, predictor, split):
        name = frame.batch.name[0]
        if not before or before[-1].batch.name[0] != previous_of.get(name):
            before = [frame]
            continue
        _check_sizes(before[-1].batch, frame.batch)
        images = [images_of(data.dataset, each) for each in (previous_of[name], name)]
        found = frame_flow(images[0], images[1], flow)
        record = flow_record(name, found, None)
        if record.used < least:
            yield Scenes((name,), {}, (frame.batch.rgb,) * 2, frame.prediction, records=(record,))
            before = [frame]
            continue
        frame = frame._replace(flow=found)
        yield _video_scene(before, frame, record)
        before = [before[-1], frame]


def _predicted(
    data: EvaluationData, frames: FramesInOrder, predictor: PairPredictor, split: str
) -> Iterator[VideoFrame]:
    """Every frame alone, in order, with its prediction."""
    for loaded in eval_batches(frames, split, data.transform, data.loading):
        batch = loaded.to(predictor.device)
        predictions = predictor.first(batch).cpu()
        for index, name in enumerate(batch.name):
            one = slice(index, index + 1)
            single = replace(
                batch,
                rgb=batch.rgb[one],
                thermal=batch.thermal[one],
                label=batch.label[one],
                name=(name,),
            )
            yield VideoFrame(single, predictions[one], None)


def _video_scene(before: list[VideoFrame], frame: VideoFrame, record: FlowRecord) -> Scenes:
    """The pair of the last two frames and, if there are three, what changes and changes back."""
    assert frame.flow is not None, "a pair has a flow"
    first, second = before[-1], frame
    followed, seen = _followed(first.prediction, [np.stack(frame.flow.source())])
    label = frame.batch.label.cpu()
    compared: dict[PairProtocol, Compared] = {
        "flow": Compared(followed, second.prediction, label, seen)
    }
    if first.flow is not None:
        earliest, was_seen = _followed(before[0].prediction, [np.stack(first.flow.source())])
        # What the second frame shows of the first one is moved on to the third.
        earliest, _ = _followed(earliest, [np.stack(frame.flow.source())])
        reached, _ = _followed(was_seen, [np.stack(frame.flow.source())])
        compared["triples"] = Compared(followed, second.prediction, earliest, seen & reached)
    images = (first.batch.rgb, second.batch.rgb)
    names = second.batch.name
    return Scenes(names, compared, images, first.prediction, 0, (frame.flow,), (record,))


def _followed(first: Tensor, sources: list[NDArray[np.int64]]) -> tuple[Tensor, Tensor]:
    """Maps (B, H, W) at the pixels of the second frame, and where these are in the first."""
    height, width = first.shape[1:]
    rows, columns = torch.from_numpy(np.stack(sources, 1))
    seen = rows >= 0
    flat = (rows * width + columns).clamp(min=0).flatten(1)
    return first.flatten(1).gather(1, flat).view_as(first), seen


def images_of(dataset: LabelledDataset, name: str) -> dict[str, NDArray[np.uint8]]:
    """Grey levels (H, W) of RGB and thermal of a frame, as stored: the same for every network."""
    sample = dataset.read(name)
    return {"rgb": gray_of(sample.rgb), "thermal": sample.thermal}


def _check_sizes(first: Batch, second: Batch) -> None:
    sizes = [" x ".join(map(str, each.label.shape[1:])) for each in (first, second)]
    if sizes[0] != sizes[1]:
        raise InputError(
            f"frames of a video must have one size, but '{first.name[0]}' has {sizes[0]} pixels "
            f"and '{second.name[0]}' has {sizes[1]}."
        )
