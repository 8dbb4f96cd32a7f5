"""Predict two frames of every scene and count them together, for TC and CA.

See `rgbt.evaluation.pair_scenes` for the second frames.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.build.session import Session
from rgbt.engine.progress import progress
from rgbt.evaluation.flow_record import FlowRecord
from rgbt.evaluation.pair_frames import check_frames
from rgbt.evaluation.pair_scenes import (
    Compared,
    PairPredictor,
    Scenes,
    next_scenes,
    video_scenes,
    virtual_scenes,
)
from rgbt.evaluation.pairing import Pairing
from rgbt.evaluation.prediction import EvaluationData, Predictor, counts_of, decode_ahead
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import CHANGES, SCORES_OF, pair_scores, value
from rgbt.metrics.names import CA, TC, consistency
from rgbt.metrics.pairs import HEADLINES, pair_counts
from rgbt.metrics.pairs import Protocol as PairProtocol
from rgbt.metrics.scores import class_mean
from rgbt.tracking.pair_pictures import PairExample
from rgbt.tracking.tables import ConsistencyTable, TextTable
from rgbt.types import Batch

CountsBySet = dict[int, NDArray[np.int64]]
"""Number of the set of views -> (K + 1, K, K) of one scene."""


@dataclass(frozen=True)
class Pairs:
    """Counts of pairs by protocol (`rgbt.metrics.pairs`), and scenes for pictures.

    Attributes:
        records: how reliable the flow of each pair is, where it is estimated.
    """

    counts: dict[PairProtocol, Counts]
    kept: tuple[PairExample, ...]
    records: tuple[FlowRecord, ...] = ()


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
    session: Session, model: nn.Module, request: EvaluationRequest, pairing: Pairing
) -> Pairs:
    """Predict both frames of every scene of a split and count, with a progress bar.

    Source: Temporal, Fig. 4 (aligned: the first prediction is warped to the second frame) and its
    release (released: it is not warped). On real second frames points follow their exact flow, and
    in videos an estimated one.

    Args:
        session: its `consistency` says which virtual views.
        model: left in evaluation mode.
        request: split, view, head, and the scenes to return for pictures.
        pairing: what the second frames are.

    Raises:
        InputError: no sets of views, no second frames, or no image that can be read.
    """
    assert request.corruption is None, "pairs are counted of clean images"
    # Requests that cannot be measured are refused before anything is drawn or predicted.
    check_frames(session, pairing.frames)
    decode_ahead(session, request.split)
    return count_predicted(session, NetworkPairs(session, model, request), request, pairing)


def count_predicted(
    data: EvaluationData, predictor: PairPredictor, request: EvaluationRequest, pairing: Pairing
) -> Pairs:
    """Count the predictions of both frames of every scene, with a progress bar.

    Args:
        data: images, labels and views.
        predictor: class maps of both frames.
        request: split, and the scenes to return for pictures.
        pairing: what the second frames are.

    Raises:
        InputError: an image or a prediction cannot be read, or no pair of a video can be used.
    """
    split, protocols = request.split, pairing.protocols
    found: dict[PairProtocol, dict[str, CountsBySet]] = {each: {} for each in protocols}
    kept: dict[str, PairExample] = {}
    records: list[FlowRecord] = []
    with progress() as display:
        task = display.add_task(f"{split} pairs", total=pairing.number(data, split), note="images")
        for scenes in _scenes(data, predictor, split, pairing):
            records += scenes.records
            for protocol, maps in scenes.compared.items():
                _count(scenes, maps, len(data.dataset.classes), found[protocol])
            if scenes.compared:
                wanted = [name for name in scenes.names if name in request.keep]
                kept |= {
                    name: _example(scenes, name, pairing.drawn)
                    for name in wanted
                    if name not in kept
                }
            done = len(records) if pairing.frames == "video" else len(found[protocols[0]])
            display.update(task, completed=done)
    pairing.check_used(records)
    counts = {
        protocol: _joined(data, split, by_name, pairing.partition(data, protocol))
        for protocol, by_name in found.items()
        if by_name or protocol != "triples"
    }
    return Pairs(counts, tuple(kept.values()), tuple(records))


def _scenes(
    data: EvaluationData, predictor: PairPredictor, split: str, pairing: Pairing
) -> Iterator[Scenes]:
    if pairing.frames == "virtual":
        return virtual_scenes(data, predictor, split)
    if pairing.frames == "next":
        return next_scenes(data, predictor, split, pairing.flow)
    assert pairing.flow is not None, "videos have an estimated flow"
    return video_scenes(data, predictor, split, pairing.flow, pairing.least_used)


def _joined(
    data: EvaluationData,
    split: str,
    by_name: Mapping[str, CountsBySet],
    partition: Callable[[int], str],
) -> Counts:
    """The counts of all sets of views, one after the other."""
    joined = {
        name: np.concatenate([by_set[number] for number in sorted(by_set)])
        for name, by_set in by_name.items()
    }
    return counts_of(data, split, joined, partition(max(map(len, by_name.values()), default=0)))


def _count(scenes: Scenes, maps: Compared, num_classes: int, found: dict[str, CountsBySet]) -> None:
    """Add the scenes of a batch; a name that a list holds twice counts once."""
    first, second, label = (each.cpu() for each in maps[:3])
    valid = None if maps.valid is None else maps.valid.cpu()
    for index, name in enumerate(scenes.names):
        seen = None if valid is None else valid[index]
        counts = pair_counts(first[index], second[index], label[index], num_classes, seen)
        found.setdefault(name, {})[scenes.number] = counts


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
        flow=scenes.flows[number].flow if scenes.flows else None,
    )


def _picture(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, 3) of an image (3, H, W) in [0, 1]."""
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def consistency_table(found: Mapping[PairProtocol, Counts], absent: Absent) -> ConsistencyTable:
    """TC and CA of every class and protocol; means over the scored classes."""
    like = next(iter(found.values()))
    scores = {
        protocol: [
            pair_scores(name, counts.by_region(), counts.partition, absent)
            for name in HEADLINES[protocol][:2]
        ]
        for protocol, counts in found.items()
        if TC in HEADLINES[protocol]
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


def changes_grid(found: Mapping[PairProtocol, Counts]) -> TextTable:
    """Warping error and flicker of every protocol that has them; percent of the pixels."""
    scores = (
        (score, protocol, counts)
        for protocol, counts in found.items()
        for score in CHANGES
        if score in SCORES_OF[protocol]
    )
    rows = tuple(
        (f"{score.replace('_', ' ')}, {protocol}", f"{value(score, counts, counts.absent):.2f}")
        for score, protocol, counts in scores
    )
    return TextTable("Changes of the prediction along the motion", ("", "% of pixels"), rows)
