"""Predict two frames of every scene and count them together, for TC and CA.

The second frame is a virtual view of the first (frames=virtual), or a true one (frames=next).
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import zip_longest
from typing import Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional as F

from rgbt.build.session import Session
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.data.next_frames import NextFrames
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import Predictor, counts_of, decode_ahead
from rgbt.evaluation.request import EvaluationRequest
from rgbt.metrics.counts import Counts
from rgbt.metrics.metric import Absent
from rgbt.metrics.named import OF_PAIRS
from rgbt.metrics.names import CA, TC, consistency
from rgbt.metrics.pairs import HEADLINES, Protocol, pair_counts, partition_name
from rgbt.metrics.scores import class_mean
from rgbt.tracking.pair_pictures import PairExample
from rgbt.tracking.tables import ConsistencyTable
from rgbt.types import IGNORE, Batch

Frames = Literal["virtual", "next"]
PROTOCOLS: dict[Frames, tuple[Protocol, ...]] = {
    "virtual": ("aligned", "released"),
    "next": ("next",),
}
"""Protocols of counting for each kind of second frame."""


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
    compared: dict[Protocol, Compared]
    images: tuple[Tensor, Tensor]
    first: Tensor
    number: int = 0


@dataclass(frozen=True)
class Pairs:
    """Counts of pairs by protocol (`rgbt.metrics.pairs`), and scenes for pictures."""

    counts: dict[Protocol, Counts]
    kept: tuple[PairExample, ...]


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
    split = request.split
    # Requests that cannot be measured are refused before anything is drawn or predicted.
    if frames == "next":
        NextFrames(session.dataset)
    elif not session.consistency.sets:
        raise InputError(
            "consistency.sets is empty. Name sets of angles, such as "
            "consistency.sets=[released_1], or choose consistency=views."
        )
    decode_ahead(session, split)
    predictor = Predictor(session, model, request)
    found: dict[Protocol, dict[str, CountsBySet]] = {each: {} for each in PROTOCOLS[frames]}
    kept: dict[str, PairExample] = {}
    scenes_of = _virtual if frames == "virtual" else _next
    with progress() as display:
        total = len(session.dataset.names(split))
        task = display.add_task(f"{split} pairs", total=total, note="images")
        for scenes in scenes_of(session, predictor, split):
            for protocol, maps in scenes.compared.items():
                _count(scenes, maps, len(session.dataset.classes), found[protocol])
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
        partition = partition_name(protocol, sets, frames_mark(session, protocol))
        counts[protocol] = counts_of(session, split, joined, partition)
    return Pairs(counts, tuple(kept.values()))


def _count(scenes: Scenes, maps: Compared, num_classes: int, found: dict[str, CountsBySet]) -> None:
    """Add the scenes of a batch; a name that a list holds twice counts once."""
    first, second, label = (each.cpu() for each in maps[:3])
    valid = None if maps.valid is None else maps.valid.cpu()
    for index, name in enumerate(scenes.names):
        seen = None if valid is None else valid[index]
        counts = pair_counts(first[index], second[index], label[index], num_classes, seen)
        found.setdefault(name, {})[scenes.number] = counts


def _virtual(session: Session, predictor: Predictor, split: str) -> Iterator[Scenes]:
    """Every batch with each set of views in turn."""
    names = session.dataset.names(split)
    # A name that the list holds twice has the views of its first position.
    position = dict(zip(reversed(names), reversed(range(len(names))), strict=True))
    for batch in eval_batches(session.dataset, split, session.transform, session.loading):
        moved = batch.to(session.fabric.device)
        first = predictor.classes(moved)
        indices = [position[name] for name in batch.name]
        for number in range(len(session.consistency.sets)):
            angles = session.consistency.angles(number, indices).to(first.device)
            yield _turned(session, predictor, moved, first, angles)._replace(number=number)


def _turned(
    session: Session, predictor: Predictor, batch: Batch, first: Tensor, angles: Tensor
) -> Scenes:
    """The scenes of a batch with virtual second frames; `first` is the prediction of the first."""
    views = session.consistency.view
    try:
        warp = views.warp(angles, (batch.rgb.shape[2], batch.rgb.shape[3]))
    except InputError as error:
        raise InputError(f"consistency.view, image '{batch.name[0]}': {error}") from error
    turned = views.batch(batch, warp)
    second = predictor.classes(turned)
    at_label = warp.resized((first.shape[1], first.shape[2]))
    valid = at_label.inside() & (turned.label != IGNORE)
    compared: dict[Protocol, Compared] = {
        "aligned": Compared(at_label.nearest(first, 0), second, turned.label, valid),
        # As released: the first prediction stays where it is, and every pixel counts.
        "released": Compared(first, second, turned.label, None),
    }
    return Scenes(batch.name, compared, (batch.rgb, turned.rgb), first)


def _next(session: Session, predictor: Predictor, split: str) -> Iterator[Scenes]:
    after = NextFrames(session.dataset)
    settings, transform = session.loading, session.transform
    pairs = zip_longest(
        eval_batches(session.dataset, split, transform, settings),
        eval_batches(after.dataset, split, transform, settings),
    )
    for batch, later in pairs:
        names = [() if each is None else each.name for each in (batch, later)]
        if names[0] != names[1]:
            raise InputError(
                f"both frames of a scene must be listed in {split} and readable, but "
                f"{session.dataset.root} has {', '.join(names[0]) or 'no further image'} where "
                f"{after.dataset.root} has {', '.join(names[1]) or 'no further image'}."
            )
        if batch.label.shape != later.label.shape:
            sizes = [" x ".join(map(str, each.label.shape[1:])) for each in (batch, later)]
            raise InputError(
                f"both frames of a scene must have the same size, but '{names[0][0]}' has "
                f"{sizes[0]} pixels in {session.dataset.root} and {sizes[1]} in "
                f"{after.dataset.root}."
            )
        moved = [each.to(session.fabric.device) for each in (batch, later)]
        first, second = (predictor.classes(each).cpu() for each in moved)
        # The first prediction at the pixels of the second frame, and where it was seen.
        height, width = first.shape[1:]
        sources = [np.stack(after.source(name, (height, width))) for name in batch.name]
        rows, columns = torch.from_numpy(np.stack(sources, 1))
        seen = rows >= 0
        flat = (rows * width + columns).clamp(min=0).flatten(1)
        followed = first.flatten(1).gather(1, flat).view_as(first)
        maps = Compared(followed, second, later.label, seen & (later.label != IGNORE))
        yield Scenes(batch.name, {"next": maps}, (moved[0].rgb, moved[1].rgb), first)


def _example(scenes: Scenes, name: str, protocol: Protocol) -> PairExample:
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


def frames_mark(session: Session, protocol: Protocol) -> str:
    """Suffix for second frames: "" for the published views, else six digits of a digest.

    For real second frames it depends on lists and files, so that another motion differs.
    """
    if protocol == "next":
        return NextFrames(session.dataset).dataset.fingerprint()[:6]
    return session.consistency.mark


def consistency_table(found: Mapping[Protocol, Counts], absent: Absent) -> ConsistencyTable:
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
