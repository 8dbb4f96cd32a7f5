"""Predict both frames of every scene, and follow points from the first to the second frame."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import chain
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.data.loaders import eval_batches
from rgbt.data.mfnet import NextFrames
from rgbt.data.video import frames_before, frames_in_order
from rgbt.dataset import LabelledDataset
from rgbt.evaluation.pairs.frames import FramePairs, frame_pairs
from rgbt.geometry.optical_flow import FrameFlow, frame_flow, gray_of
from rgbt.metrics.pairs import Protocol
from rgbt.types import IGNORE, Batch

# Class maps (B, H', W') uint8, at the size of the labels, of frames and their names.
Predict = Callable[[Batch, Sequence[str]], Tensor]


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


def scenes(pairs: FramePairs, predict: Predict, device: torch.device) -> Iterator[Scenes]:
    """Yield both predictions of every scene, compared point by point."""
    if pairs.frames == "virtual":
        return _virtual_scenes(pairs, predict, device)
    if pairs.frames == "next":
        return _next_scenes(pairs, predict, device)
    return _video_scenes(pairs, predict, device)


def _virtual_scenes(pairs: FramePairs, predict: Predict, device: torch.device) -> Iterator[Scenes]:
    first = torch.empty(0)
    for batch in frame_pairs(pairs, device):
        assert batch.warp is not None, "views are warped"
        if batch.number == 0:
            first = predict(batch.first, batch.first.name)
        second, label = predict(batch.second, batch.names), batch.second.label
        at_label = batch.warp.resized((first.shape[1], first.shape[2]))
        valid = at_label.inside() & (label != IGNORE)
        compared: dict[Protocol, Compared] = {
            "aligned": Compared(at_label.nearest(first, 0), second, label, valid),
            # The release does this: the first prediction stays where it is, and every pixel counts.
            "released": Compared(first, second, label, None),
        }
        images = (batch.first.rgb, batch.second.rgb)
        yield Scenes(batch.first.name, compared, images, first, batch.number)


def _next_scenes(pairs: FramePairs, predict: Predict, device: torch.device) -> Iterator[Scenes]:
    """Follow the exact flow, and if one is requested also an estimated flow."""
    after = NextFrames(pairs.dataset)
    for batch in frame_pairs(pairs, device):
        names, label = batch.first.name, batch.second.label.cpu()
        first = predict(batch.first, names).cpu()
        second = predict(batch.second, batch.names).cpu()
        image_hw = (first.shape[1], first.shape[2])
        sources: dict[Protocol, list[NDArray[np.int64]]] = {}
        sources["next"] = [np.stack(after.source(name, image_hw)) for name in names]
        flows, records = [], []
        if pairs.flow is not None:
            for name in names:
                before, later = _gray(pairs.dataset, name), _gray(after.dataset, name)
                flows.append(frame_flow(before, later, pairs.flow))
                records.append(flow_record(name, flows[-1], after.flow(name, image_hw)))
            sources["flow"] = [np.stack(flow.source()) for flow in flows]
        compared: dict[Protocol, Compared] = {}
        for protocol in pairs.protocols:
            followed, seen = _followed(first, sources[protocol])
            compared[protocol] = Compared(followed, second, label, seen & (label != IGNORE))
        images = (batch.first.rgb, batch.second.rgb)
        yield Scenes(names, compared, images, first, 0, tuple(flows), tuple(records))


def _video_scenes(pairs: FramePairs, predict: Predict, device: torch.device) -> Iterator[Scenes]:
    """Follow every pair of consecutive frames; one with too few used pixels begins triples anew."""
    assert pairs.flow is not None, "videos have an estimated flow"
    sequences = frames_in_order(pairs.dataset, pairs.split)
    previous_of = frames_before(sequences)
    before: tuple[Batch, Tensor] | None = None
    # Prediction of the frame before `before`, followed to it, and where that one shows it.
    moved: tuple[Tensor, Tensor] | None = None
    names = tuple(chain.from_iterable(sequences))
    for frame, second in _predicted(pairs, names, predict, device):
        name = frame.name[0]
        earlier, before = before, (frame, second)
        if earlier is None or earlier[0].name[0] != previous_of.get(name):
            moved = None
            continue
        first_frame, first = earlier
        dataset = pairs.dataset
        flow = frame_flow(_gray(dataset, previous_of[name]), _gray(dataset, name), pairs.flow)
        record, images = flow_record(name, flow), (first_frame.rgb, frame.rgb)
        compared: dict[Protocol, Compared] = {}
        if record.used < pairs.least_used:
            moved = None
        else:
            source = [np.stack(flow.source())]
            followed, seen = _followed(first, source)
            compared["flow"] = Compared(followed, second, frame.label.cpu(), seen)
            if moved is not None:
                # What the second frame shows of the first one is moved on to the third.
                earliest, reached = _followed(moved[0], source)[0], _followed(moved[1], source)[0]
                compared["triples"] = Compared(followed, second, earliest, seen & reached)
            moved = followed, seen
        yield Scenes((name,), compared, images, first, 0, (flow,), (record,))


def _predicted(
    pairs: FramePairs, names: tuple[str, ...], predict: Predict, device: torch.device
) -> Iterator[tuple[Batch, Tensor]]:
    """Yield every frame alone, in order, with its prediction (1, H', W')."""
    for loaded in eval_batches(pairs.dataset, names, pairs.transform, pairs.loading):
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


def _gray(dataset: LabelledDataset, name: str) -> dict[str, NDArray[np.uint8]]:
    """Grey levels (H, W) of RGB and thermal of a frame, as stored: the same for every network."""
    sample = dataset.read(name)
    return {"rgb": gray_of(sample.rgb), "thermal": sample.thermal}


def flow_record(
    name: str, found: FrameFlow, exact: NDArray[np.float32] | None = None
) -> FlowRecord:
    """Compare the flow of a pair with the `exact` one (H, W, 2), NaN where a point is hidden."""
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
