"""Predict two frames of every scene and count them together, for TC and CA.

The second frame is a virtual view of the first (frames=virtual), or a true one (frames=next).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.build.session import Session
from rgbt.data.next_frames import NextFrames
from rgbt.engine.progress import progress
from rgbt.evaluation.pair_frames import (
    PROTOCOLS,
    check_frames,
    frames_mark,
    next_frames,
    virtual_frames,
)
from rgbt.evaluation.prediction import EvaluationData, Predictor, counts_of, decode_ahead
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import OF_PAIRS
from rgbt.metrics.names import CA, TC, consistency
from rgbt.metrics.pair_list import Frames
from rgbt.metrics.pairs import HEADLINES, pair_counts, partition_name
from rgbt.metrics.pairs import Protocol as PairProtocol
from rgbt.metrics.scores import class_mean
from rgbt.tracking.pair_pictures import PairExample
from rgbt.tracking.tables import ConsistencyTable
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


CountsBySet = dict[int, NDArray[np.int64]]
"""Number of the set of views -> (K + 1, K, K) of one scene."""


class Scenes(NamedTuple):
    """A batch of scenes with both predictions.

    Attributes:
        names: of the B scenes.
        compared: class maps (B, H', W') by protocol.
        images: (B, 3, H, W) float in [0, 1], RGB of both frames.
        first: (B, H', W') prediction of the first frame, in its own pixels.
        number: of the set of views, from 0.
    """

    names: tuple[str, ...]
    compared: dict[PairProtocol, Compared]
    images: tuple[Tensor, Tensor]
    first: Tensor
    number: int = 0


@dataclass(frozen=True)
class Pairs:
    """Counts of pairs by protocol (`rgbt.metrics.pairs`), and scenes for pictures."""

    counts: dict[PairProtocol, Counts]
    kept: tuple[PairExample, ...]


class PairPredictor(Protocol):
    """Class maps (B, H', W') uint8 of both frames, at the size of their labels."""

    @property
    def device(self) -> torch.device:
        """Where batches are expected."""

    def first(self, batch: Batch) -> Tensor:
        """Of first frames."""

    def second(self, batch: Batch, number: int) -> Tensor:
        """Of second frames; `number` of the set of views, from 0."""


class NetworkPairs:
    """Both frames predicted by a network, left in evaluation mode."""

    def __init__(self, session: Session, model: nn.Module, request: EvaluationRequest) -> None:
        self._predictor = Predictor(session, model, request)
        self.device = session.fabric.device

    def first(self, batch: Batch) -> Tensor:
        """See `PairPredictor`."""
        return self._predictor.classes(batch)

    def second(self, batch: Batch, number: int) -> Tensor:  # noqa: ARG002 - the same for all views
        """See `PairPredictor`."""
        return self._predictor.classes(batch)


def count_pairs(
    session: Session, model: nn.Module, request: EvaluationRequest, frames: Frames
) -> Pairs:
    """Predict both frames of every scene of a split and count, with a progress bar.

    Source: Temporal, Fig. 4 (aligned: the first prediction is warped to the second frame) and its
    release (released: it is not warped). On real second frames points follow their exact flow.

    Args:
        session: its `consistency` says which virtual views.
        model: left in evaluation mode.
        request: split, view, head, and the scenes to return for pictures.
        frames: what the second frames are.

    Raises:
        InputError: no sets of views, no second frames, or no image that can be read.
    """
    assert request.corruption is None, "pairs are counted of clean images"
    # Requests that cannot be measured are refused before anything is drawn or predicted.
    check_frames(session, frames)
    decode_ahead(session, request.split)
    return count_predicted(session, NetworkPairs(session, model, request), request, frames)


def count_predicted(
    data: EvaluationData, predictor: PairPredictor, request: EvaluationRequest, frames: Frames
) -> Pairs:
    """Count the predictions of both frames of every scene, with a progress bar.

    Args:
        data: images, labels and views.
        predictor: class maps of both frames.
        request: split, and the scenes to return for pictures.
        frames: what the second frames are.

    Raises:
        InputError: an image or a prediction cannot be read.
    """
    split = request.split
    found: dict[PairProtocol, dict[str, CountsBySet]] = {each: {} for each in PROTOCOLS[frames]}
    kept: dict[str, PairExample] = {}
    scenes_of = _virtual if frames == "virtual" else _next
    with progress() as display:
        total = len(data.dataset.names(split))
        task = display.add_task(f"{split} pairs", total=total, note="images")
        for scenes in scenes_of(data, predictor, split):
            for protocol, maps in scenes.compared.items():
                _count(scenes, maps, len(data.dataset.classes), found[protocol])
            wanted = [name for name in scenes.names if name in request.keep and name not in kept]
            kept |= {name: _example(scenes, name, PROTOCOLS[frames][0]) for name in wanted}
            display.update(task, completed=len(found[PROTOCOLS[frames][0]]))
    counts = {}
    for protocol, by_name in found.items():
        joined = {
            name: np.concatenate([by_set[number] for number in sorted(by_set)])
            for name, by_set in by_name.items()
        }
        sets = max(map(len, by_name.values()), default=0)
        partition = partition_name(protocol, sets, frames_mark(data, protocol))
        counts[protocol] = counts_of(data, split, joined, partition)
    return Pairs(counts, tuple(kept.values()))


def _count(scenes: Scenes, maps: Compared, num_classes: int, found: dict[str, CountsBySet]) -> None:
    """Add the scenes of a batch; a name that a list holds twice counts once."""
    first, second, label = (each.cpu() for each in maps[:3])
    valid = None if maps.valid is None else maps.valid.cpu()
    for index, name in enumerate(scenes.names):
        seen = None if valid is None else valid[index]
        counts = pair_counts(first[index], second[index], label[index], num_classes, seen)
        found.setdefault(name, {})[scenes.number] = counts


def _virtual(data: EvaluationData, predictor: PairPredictor, split: str) -> Iterator[Scenes]:
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


def _next(data: EvaluationData, predictor: PairPredictor, split: str) -> Iterator[Scenes]:
    after = NextFrames(data.dataset)
    for batch, later in next_frames(data, after, split, predictor.device):
        first, second = predictor.first(batch).cpu(), predictor.second(later, 0).cpu()
        # The first prediction at the pixels of the second frame, and where it was seen.
        height, width = first.shape[1:]
        sources = [np.stack(after.source(name, (height, width))) for name in batch.name]
        rows, columns = torch.from_numpy(np.stack(sources, 1))
        seen = rows >= 0
        flat = (rows * width + columns).clamp(min=0).flatten(1)
        followed = first.flatten(1).gather(1, flat).view_as(first)
        label = later.label.cpu()
        maps = Compared(followed, second, label, seen & (label != IGNORE))
        yield Scenes(batch.name, {"next": maps}, (batch.rgb, later.rgb), first)


def _example(scenes: Scenes, name: str, protocol: PairProtocol) -> PairExample:
    maps, number = scenes.compared[protocol], scenes.names.index(name)
    label_hw = (scenes.first.shape[1], scenes.first.shape[2])
    first_rgb, second_rgb = (
        F.interpolate(images[number : number + 1], label_hw, mode="bilinear", align_corners=False)
        for images in scenes.images
    )
    assert maps.valid is not None, "the protocol that is drawn says what is seen"
    return PairExample(
        name=name,
        first_rgb=_picture(first_rgb[0]),
        first=scenes.first[number].cpu().numpy(),
        second_rgb=_picture(second_rgb[0]),
        second=maps.second[number].cpu().numpy(),
        followed=maps.first[number].cpu().numpy(),
        seen=maps.valid[number].cpu().numpy(),
    )


def _picture(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) of an image (3, H, W) in [0, 1]."""
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def consistency_table(found: Mapping[PairProtocol, Counts], absent: Absent) -> ConsistencyTable:
    """TC and CA of every class and protocol; means over the scored classes."""
    like = next(iter(found.values()))
    scores = {
        protocol: [OF_PAIRS[name](counts.by_region(), absent) for name in HEADLINES[protocol]]
        for protocol, counts in found.items()
    }
    return ConsistencyTable(
        names=like.classes,
        tc={protocol: tuple(map(float, tc)) for protocol, (tc, _) in scores.items()},
        ca={protocol: tuple(map(float, ca)) for protocol, (_, ca) in scores.items()},
        mean_tc={each: float(class_mean(tc, like.scored)) for each, (tc, _) in scores.items()},
        mean_ca={each: float(class_mean(ca, like.scored)) for each, (_, ca) in scores.items()},
        unscored=like.unscored,
    )


def consistency_values(table: ConsistencyTable) -> dict[str, float]:
    """The means as metrics of a run, as fractions: "TC/aligned", "CA/aligned", ..."""
    return {
        consistency(score, protocol): means[protocol]
        for protocol in table.tc
        for score, means in ((TC, table.mean_tc), (CA, table.mean_ca))
    }
