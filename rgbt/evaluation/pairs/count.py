"""Count both predictions of every scene together, for TC and CA, and make their tables."""

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
from rgbt.evaluation.measure import counts_of, of_partition, predictor_of
from rgbt.evaluation.pairs.frames import FramePairs
from rgbt.evaluation.pairs.scenes import Compared, FlowRecord, Predict, Scenes, scenes
from rgbt.metrics.counting import pair_counts
from rgbt.metrics.counts import Counts
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import CHANGES, SCORES_OF, pair_scores, value
from rgbt.metrics.names import CA, TC, consistency
from rgbt.metrics.pairs import HEADLINES, Protocol, partition_name
from rgbt.metrics.scores import absent_rule, class_mean
from rgbt.tables import ConsistencyTable, TextTable
from rgbt.terminal import progress
from rgbt.tracking.pair_pictures import PairExample

# Number of the set of views -> (K + 1, K, K) of one scene.
CountsBySet = dict[int, NDArray[np.int64]]


@dataclass(frozen=True)
class CountedPairs:
    """Counts of pairs by protocol (`rgbt.metrics.pairs`), scenes for pictures, flow records."""

    counts: dict[Protocol, Counts]
    kept: tuple[PairExample, ...]
    records: tuple[FlowRecord, ...] = ()


def count_pairs(
    session: Session, wanted: Measurement, pairs: FramePairs, keep: Collection[str] = ()
) -> CountedPairs:
    """Predict both frames of every scene of a split, with the network left in evaluation mode.

    Source: Temporal, Fig. 4 (aligned: the first prediction is warped to the second frame) and its
    release (released: it is not warped).

    Args:
        session: with the network.
        wanted: the measurement of the network on the split of `pairs`.
        pairs: the pairs of frames of its data set.
        keep: names of scenes that are returned for pictures.

    Raises:
        InputError: no image can be read, or a measurement that does not fit the network.
    """
    predictor = predictor_of(session, wanted)
    return count_predicted(
        pairs, lambda batch, _: predictor.classes(batch), wanted, session.device, keep
    )


def count_predicted(
    pairs: FramePairs,
    predict: Predict,
    wanted: Measurement,
    device: torch.device,
    keep: Collection[str] = (),
) -> CountedPairs:
    """Count what `predict` says of both frames of every scene, in batches on `device`.

    Raises:
        InputError: an image or a prediction cannot be read, or no pair of a video can be used.
    """
    num_classes, protocols = len(pairs.dataset.classes), pairs.protocols
    found: dict[Protocol, dict[str, CountsBySet]] = {protocol: {} for protocol in protocols}
    kept: dict[str, PairExample] = {}
    records: list[FlowRecord] = []
    with progress() as display:
        total = len(pairs.names)
        task = display.add_task(f"{pairs.split} pairs", total=total, note="images")
        for batch in scenes(pairs, predict, device):
            records += batch.records
            for protocol, maps in batch.compared.items():
                _count(batch, maps, num_classes, found[protocol])
            _keep(batch, "flow" if pairs.flow else protocols[0], keep, kept)
            done = len(records) if pairs.frames == "video" else len(found[protocols[0]])
            display.update(task, completed=done)
    most_used = max((record.used for record in records), default=0.0)
    if pairs.frames == "video" and (not records or most_used < pairs.least_used):
        raise InputError(
            f"least_used={pairs.least_used:g}: no pair of frames has a reliable flow at this "
            f"share of its pixels (at most {most_used:.3f})."
        )
    counts = {}
    for protocol, by_name in found.items():
        if protocol == "triples" and not by_name:
            continue
        joined = {name: np.concatenate([*by_set.values()]) for name, by_set in by_name.items()}
        sets = max(map(len, by_name.values()), default=0)
        partition = partition_name(protocol, sets, pairs.mark(protocol))
        by_scene = counts_of(pairs.dataset, of_partition(wanted, partition), joined)
        counts[protocol] = by_scene.added(pairs.views.scenes_per_count)
    return CountedPairs(counts, tuple(kept.values()), tuple(records))


def _count(batch: Scenes, maps: Compared, num_classes: int, found: dict[str, CountsBySet]) -> None:
    """Add the scenes of a batch; a name that a list holds twice counts once."""
    first, second, label = maps.first.cpu(), maps.second.cpu(), maps.label.cpu()
    valid = None if maps.valid is None else maps.valid.cpu()
    for at, name in enumerate(batch.names):
        seen = None if valid is None else valid[at]
        counts = pair_counts(first[at], second[at], label[at], num_classes, seen)
        found.setdefault(name, {})[batch.number] = counts


def _keep(
    batch: Scenes, protocol: Protocol, keep: Collection[str], kept: dict[str, PairExample]
) -> None:
    """Add the scenes of a batch that are drawn to `kept`, each once."""
    for at, name in enumerate(batch.names):
        if name not in keep or name in kept or not batch.compared:
            continue
        maps = batch.compared[protocol]
        assert maps.valid is not None, "the protocol that is drawn says what is seen"
        label_hw = (batch.first.shape[1], batch.first.shape[2])
        kept[name] = PairExample(
            name=name,
            first_rgb=_picture(batch.images[0][at], label_hw),
            first=batch.first[at].cpu().numpy(),
            second_rgb=_picture(batch.images[1][at], label_hw),
            second=maps.second[at].cpu().numpy(),
            followed=maps.first[at].cpu().numpy(),
            seen=maps.valid[at].cpu().numpy(),
            flow=batch.flows[at].flow if batch.flows else None,
        )


def _picture(image: Tensor, image_hw: tuple[int, int]) -> NDArray[np.uint8]:
    """(H, W, 3) of an image (3, H', W') in [0, 1]."""
    return to_bytes(F.interpolate(image[None], image_hw, mode="bilinear", align_corners=False)[0])


def to_bytes(image: Tensor) -> NDArray[np.uint8]:
    """Return bytes (H, W, C) of an image (C, H, W) in [0, 1]."""
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0).cpu().numpy()


def consistency_table(found: Mapping[Protocol, Counts], absent: Absent) -> ConsistencyTable:
    """Compute TC and CA of every class and protocol; means are over the scored classes."""
    like = next(iter(found.values()))
    # Of TC, then of CA: by protocol the scores of the classes, and their mean.
    by_class: list[dict[str, tuple[float, ...]]] = [{}, {}]
    means: list[dict[str, float]] = [{}, {}]
    for protocol, counts in found.items():
        if TC not in HEADLINES[protocol]:
            continue
        for number, name in enumerate(HEADLINES[protocol][:2]):
            scores = pair_scores(name, counts, absent)
            by_class[number][protocol] = tuple(map(float, scores))
            means[number][protocol] = float(class_mean(scores, like.scored))
    there = pair_scores(TC, like, "exclude")
    lacking = [name for name, tc in zip(like.classes, there, strict=True) if np.isnan(tc)]
    return ConsistencyTable(
        names=like.classes,
        tc=by_class[0],
        ca=by_class[1],
        mean_tc=means[0],
        mean_ca=means[1],
        unscored=like.unscored,
        notes=(f"{absent_rule(absent)} Without one: {', '.join(lacking) or 'no class'}.",),
    )


def consistency_values(table: ConsistencyTable) -> dict[str, float]:
    """Return the means as metrics of a run, as fractions: "TC/aligned", "CA/aligned", ..."""
    return {
        consistency(score, protocol): means[protocol]
        for protocol in table.tc
        for score, means in ((TC, table.mean_tc), (CA, table.mean_ca))
    }


def changes_grid(found: Mapping[Protocol, Counts]) -> TextTable:
    """Make the table of warping error and flicker, by protocol that has them; percent of pixels."""
    rows = []
    for protocol, counts in found.items():
        for score in CHANGES:
            if score in SCORES_OF[protocol]:
                share = value(score, counts, counts.absent)
                rows.append((f"{score.replace('_', ' ')}, {protocol}", f"{share:.2f}"))
    title = "Changes of the prediction along the motion"
    return TextTable(title, ("", "% of pixels"), tuple(rows))
