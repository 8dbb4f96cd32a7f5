"""Predict two frames of every scene and count them together, for TC and CA.

See `rgbt.evaluation.pair_frames` for the second frames.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn import functional as F

from rgbt.assembly.session import Session
from rgbt.checks import InputError
from rgbt.engine.progress import progress
from rgbt.evaluation.measure import check, counts_of, of_partition
from rgbt.evaluation.pair_frames import (
    Compared,
    EvaluationData,
    FlowRecord,
    Pairing,
    Predict,
    Scenes,
    scenes,
)
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import CHANGES, SCORES_OF, pair_scores, value
from rgbt.metrics.names import CA, TC, consistency
from rgbt.metrics.pairs import HEADLINES, Protocol, partition_name
from rgbt.metrics.scores import absent_rule, class_mean
from rgbt.tables import ConsistencyTable, TextTable
from rgbt.tracking.pair_pictures import PairExample

# Number of the set of views -> (K + 1, K, K) of one scene.
CountsBySet = dict[int, NDArray[np.int64]]


@dataclass(frozen=True)
class Pairs:
    """Counts of pairs by protocol (`rgbt.metrics.pairs`), scenes for pictures, flow records."""

    counts: dict[Protocol, Counts]
    kept: tuple[PairExample, ...]
    records: tuple[FlowRecord, ...] = ()


def count_pairs(
    session: Session, wanted: Measurement, pairing: Pairing, keep: Collection[str] = ()
) -> Pairs:
    """Predict both frames of every scene of a split, with the network left in evaluation mode.

    Source: Temporal, Fig. 4 (aligned: the first prediction is warped to the second frame) and its
    release (released: it is not warped). `session.consistency` says which virtual views; `keep` are
    names of scenes that are returned for pictures.

    Raises:
        InputError: no sets of views, no second frames, or no image that can be read.
    """
    # What cannot be measured is refused before anything is drawn or predicted.
    pairing.check(session)
    predictor = check(session, wanted)
    return count_predicted(
        session, lambda batch, _: predictor.classes(batch), wanted, pairing, session.device, keep
    )


def count_predicted(
    data: EvaluationData,
    predict: Predict,
    wanted: Measurement,
    pairing: Pairing,
    device: torch.device,
    keep: Collection[str] = (),
) -> Pairs:
    """Count what `predict` says of both frames of every scene, in batches on `device`.

    Raises:
        InputError: an image or a prediction cannot be read, or no pair of a video can be used.
    """
    split, num_classes = wanted.split, len(data.dataset.classes)
    found: dict[Protocol, dict[str, CountsBySet]] = {each: {} for each in pairing.protocols}
    kept: dict[str, PairExample] = {}
    records: list[FlowRecord] = []
    drawn: Protocol = "flow" if pairing.flow else pairing.protocols[0]
    with progress() as display:
        total = len(pairing.names(data, split))
        task = display.add_task(f"{split} pairs", total=total, note="images")
        for batch in scenes(data, predict, split, pairing, device):
            records += batch.records
            for protocol, maps in batch.compared.items():
                _count(batch, maps, num_classes, found[protocol])
            new = [name for name in batch.names if name in keep and name not in kept]
            kept |= {name: _example(batch, name, drawn) for name in new if batch.compared}
            done = len(records) if pairing.frames == "video" else len(found[pairing.protocols[0]])
            display.update(task, completed=done)
    if pairing.frames == "video" and all(each.used < pairing.least_used for each in records):
        raise InputError(
            f"least_used={pairing.least_used:g}: no pair of frames has a reliable flow at this "
            f"share of its pixels (at most {max((each.used for each in records), default=0):.3f})."
        )
    counts = {}
    for protocol, by_name in found.items():
        if protocol == "triples" and not by_name:
            continue
        joined = {name: np.concatenate([*by_set.values()]) for name, by_set in by_name.items()}
        sets = max(map(len, by_name.values()), default=0)
        partition = partition_name(protocol, sets, pairing.mark(data, protocol))
        each_scene = counts_of(data.dataset, of_partition(wanted, partition), joined)
        counts[protocol] = each_scene.added(data.consistency.scenes_per_count)
    return Pairs(counts, tuple(kept.values()), tuple(records))


def _count(batch: Scenes, maps: Compared, num_classes: int, found: dict[str, CountsBySet]) -> None:
    """Add the scenes of a batch; a name that a list holds twice counts once."""
    first, second, label = (each.cpu() for each in maps[:3])
    valid = None if maps.valid is None else maps.valid.cpu()
    for at, name in enumerate(batch.names):
        seen = None if valid is None else valid[at]
        counts = pair_counts(first[at], second[at], label[at], num_classes, seen)
        found.setdefault(name, {})[batch.number] = counts


def _example(batch: Scenes, name: str, protocol: Protocol) -> PairExample:
    maps, number = batch.compared[protocol], batch.names.index(name)
    assert maps.valid is not None, "the protocol that is drawn says what is seen"
    label_hw = (batch.first.shape[1], batch.first.shape[2])
    first_rgb, second_rgb = (_picture(images[number], label_hw) for images in batch.images)
    first, second, followed, seen = (
        each[number].cpu().numpy() for each in (batch.first, maps.second, maps.first, maps.valid)
    )
    flow = batch.flows[number].flow if batch.flows else None
    return PairExample(name, first_rgb, first, second_rgb, second, followed, seen, flow)


def _picture(image: Tensor, image_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) of an image (3, H', W') in [0, 1]."""
    return to_bytes(F.interpolate(image[None], image_hw, mode="bilinear", align_corners=False)[0])


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, C) of an image (C, H, W) in [0, 1]."""
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def consistency_table(found: Mapping[Protocol, Counts], absent: Absent) -> ConsistencyTable:
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
    there = pair_scores(TC, like.by_region(), like.partition, "exclude")
    lacking = [name for name, tc in zip(like.classes, there, strict=True) if np.isnan(tc)]
    return ConsistencyTable(
        names=like.classes,
        tc={protocol: tuple(map(float, tc)) for protocol, (tc, _) in scores.items()},
        ca={protocol: tuple(map(float, ca)) for protocol, (_, ca) in scores.items()},
        mean_tc={each: float(class_mean(tc, like.scored)) for each, (tc, _) in scores.items()},
        mean_ca={each: float(class_mean(ca, like.scored)) for each, (_, ca) in scores.items()},
        unscored=like.unscored,
        notes=(f"{absent_rule(absent)} Without one: {', '.join(lacking) or 'no class'}.",),
    )


def consistency_values(table: ConsistencyTable) -> dict[str, float]:
    """The means as metrics of a run, as fractions: "TC/aligned", "CA/aligned", ..."""
    return {
        consistency(score, protocol): means[protocol]
        for protocol in table.tc
        for score, means in ((TC, table.mean_tc), (CA, table.mean_ca))
    }


def changes_grid(found: Mapping[Protocol, Counts]) -> TextTable:
    """Warping error and flicker of every protocol that has them; percent of the pixels."""
    rows = tuple(
        (f"{score.replace('_', ' ')}, {protocol}", f"{value(score, counts, counts.absent):.2f}")
        for protocol, counts in found.items()
        for score in CHANGES
        if score in SCORES_OF[protocol]
    )
    return TextTable("Changes of the prediction along the motion", ("", "% of pixels"), rows)
