"""Predictions of two frames of every scene, counted together: what TC and CA are derived from.

The second frame is a virtual view of the first (frames=virtual), or a true one (frames=next).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
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
from rgbt.engine.evaluate import class_maps
from rgbt.engine.progress import progress
from rgbt.evaluation.prediction import decode_ahead, heads_of, view_of
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

Predict = Callable[[Batch], Tensor]
"""A batch on the device -> its class maps (B, H', W') uint8."""

Frames = Literal["virtual", "next"]
PROTOCOLS: dict[Frames, tuple[Protocol, ...]] = {
    "virtual": ("aligned", "released"),
    "next": ("next",),
}
"""What is counted of which second frames."""


class Compared(NamedTuple):
    """Class maps (H', W') of one scene, as one protocol compares them.

    Attributes:
        first: prediction of the first frame.
        second: prediction of the second frame.
        label: label of the second frame.
        valid: pixels that count; None: all.
    """

    first: Tensor
    second: Tensor
    label: Tensor
    valid: Tensor | None


@dataclass
class Collected:
    """Counts of one protocol: name -> number of the set of views -> (K + 1, K, K)."""

    by_name: dict[str, dict[int, NDArray[np.int64]]] = field(default_factory=dict)

    def add(self, scenes: Scenes, compared: Compared, num_classes: int) -> None:
        """Count the scenes of a batch; a name that a list holds twice counts once."""
        for name, each in zip(scenes.names, _each(compared), strict=True):
            counts = pair_counts(each.first, each.second, each.label, num_classes, each.valid)
            self.by_name.setdefault(name, {})[scenes.number] = counts


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
    number: int


@dataclass(frozen=True)
class Pairs:
    """What `count_pairs` found.

    Attributes:
        counts: by protocol, see `rgbt.metrics.pairs`.
        kept: scenes for pictures.
    """

    counts: dict[Protocol, Counts]
    kept: tuple[PairExample, ...]


def count_pairs(
    session: Session, model: nn.Module, request: EvaluationRequest, frames: Frames
) -> Pairs:
    """Predict both frames of every scene of a split and count, with a progress bar.

    Source: Temporal, Fig. 4 (aligned: the first prediction is brought into the second frame) and
    its release (released: it is not). On true frames points are followed by their exact flow.

    Args:
        session: see `rgbt.build.session.open_session`; its `consistency` says which virtual views.
        model: the network to evaluate; left in evaluation mode.
        request: split, view, head, and the scenes to return for pictures.
        frames: what the second frames are.

    Raises:
        InputError: no sets of views, no second frames, or no image that can be read.
    """
    assert request.corruption is None, "pairs are counted of clean images"
    split = request.split
    _check_second_frames(session, frames)
    decode_ahead(session, split)
    model.eval()
    found: dict[Protocol, Collected] = {each: Collected() for each in PROTOCOLS[frames]}
    kept: dict[str, PairExample] = {}
    view = view_of(session, request.view)
    heads = heads_of(session, view, request.head)

    def predict(batch: Batch) -> Tensor:
        return class_maps(model, batch, session.fabric, view, heads(batch.name))

    scenes_of = _virtual if frames == "virtual" else _next
    num_classes = len(session.dataset.classes)
    with progress() as display:
        total = len(session.dataset.names(split))
        task = display.add_task(f"{split} pairs", total=total, note="images")
        for scenes in scenes_of(session, predict, split):
            for protocol, maps in scenes.compared.items():
                found[protocol].add(scenes, maps, num_classes)
            wanted = [name for name in scenes.names if name in request.keep and name not in kept]
            kept |= {name: _example(scenes, name, PROTOCOLS[frames][0]) for name in wanted}
            display.update(task, completed=len(next(iter(found.values())).by_name))
    counts = {protocol: _counts(session, split, protocol, each) for protocol, each in found.items()}
    return Pairs(counts, tuple(kept.values()))


def _check_second_frames(session: Session, frames: Frames) -> None:
    """Refuse what cannot be measured before anything is drawn or predicted."""
    if frames == "next":
        NextFrames(session.dataset)
    elif not session.consistency.sets:
        raise InputError(
            "consistency.sets is empty: no virtual views are named; name sets of angles, such as "
            "consistency.sets=[released_1], or give consistency=views."
        )


def _virtual(session: Session, predict: Predict, split: str) -> Iterator[Scenes]:
    """Every batch with each set of views in turn."""
    sets = session.consistency
    names = session.dataset.names(split)
    # A name that the list holds twice has the views of its first position.
    position = dict(zip(reversed(names), reversed(range(len(names))), strict=True))
    for batch in eval_batches(session.dataset, split, session.transform, session.loading):
        moved = batch.to(session.fabric.device)
        first = predict(moved)
        indices = [position[name] for name in batch.name]
        for number in range(len(sets.sets)):
            yield _turned(session, predict, moved, first, (number, indices))


def _turned(
    session: Session, predict: Predict, batch: Batch, first: Tensor, turn: tuple[int, list[int]]
) -> Scenes:
    views, angles = session.consistency.view, session.consistency.angles(*turn)
    try:
        warp = views.warp(angles.to(first.device), (batch.rgb.shape[2], batch.rgb.shape[3]))
    except InputError as error:
        raise InputError(f"consistency.view, image '{batch.name[0]}': {error}") from error
    turned = views.batch(batch, warp)
    second = predict(turned)
    at_label = warp.resized((first.shape[1], first.shape[2]))
    aligned = Compared(
        at_label.nearest(first, 0),
        second,
        turned.label,
        at_label.inside() & (turned.label != IGNORE),
    )
    # As released: the first prediction stays where it is, and every pixel counts.
    released = Compared(first, second, turned.label, None)
    compared: dict[Protocol, Compared] = {"aligned": aligned, "released": released}
    return Scenes(batch.name, compared, (batch.rgb, turned.rgb), first, turn[0])


def _next(session: Session, predict: Predict, split: str) -> Iterator[Scenes]:
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
                f"both frames of a scene must be listed in {split} and readable: "
                f"{session.dataset.root} gives {', '.join(names[0]) or 'nothing more'}, "
                f"{after.dataset.root} {', '.join(names[1]) or 'nothing more'}."
            )
        if batch.label.shape != later.label.shape:
            sizes = [" x ".join(map(str, each.label.shape[1:])) for each in (batch, later)]
            raise InputError(
                f"both frames of a scene must have one size, but '{names[0][0]}' has "
                f"{sizes[0]} pixels in {session.dataset.root} and {sizes[1]} in "
                f"{after.dataset.root}."
            )
        moved = [each.to(session.fabric.device) for each in (batch, later)]
        first, second = (predict(each).cpu() for each in moved)
        followed, seen = _followed(after, batch.name, first)
        valid = seen & (later.label != IGNORE)
        compared: dict[Protocol, Compared] = {
            "next": Compared(followed, second, later.label, valid)
        }
        yield Scenes(batch.name, compared, (moved[0].rgb, moved[1].rgb), first, 0)


def _followed(after: NextFrames, names: Iterable[str], first: Tensor) -> tuple[Tensor, Tensor]:
    """The first prediction at the pixels of the second frame, and where it was seen."""
    height, width = first.shape[1:]
    places = [np.stack(after.source(name, (height, width))) for name in names]
    rows, columns = torch.from_numpy(np.stack(places, 1))
    seen = rows >= 0
    flat = (rows * width + columns).clamp(min=0).flatten(1)
    return first.flatten(1).gather(1, flat).view_as(first), seen


def _each(maps: Compared) -> Iterator[Compared]:
    """The scenes of a batch, on the CPU."""
    first, second, label = (each.cpu() for each in maps[:3])
    valid = None if maps.valid is None else maps.valid.cpu()
    for number in range(len(first)):
        shown = None if valid is None else valid[number]
        yield Compared(first[number], second[number], label[number], shown)


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


def _counts(session: Session, split: str, protocol: Protocol, collected: Collected) -> Counts:
    dataset = session.dataset
    if not collected.by_name:
        raise InputError(f"split '{split}' of {dataset.name}: no image could be read.")
    names = tuple(collected.by_name)
    arrays = [
        np.concatenate([by_set[number] for number in sorted(by_set)])
        for by_set in collected.by_name.values()
    ]
    sets = len(collected.by_name[names[0]])
    return Counts(
        counts=np.stack(arrays).astype(np.int32),
        names=names,
        night=dataset.nights(names),
        classes=dataset.classes,
        partition=partition_name(protocol, sets, frames_mark(session, protocol)),
        dataset=dataset.fingerprint(),
        split=split,
        unscored=dataset.unscored,
        absent=session.regions.absent,
    )


def frames_mark(session: Session, protocol: Protocol) -> str:
    """Which second frames counts are of: "" for the published views, else six digits of others.

    True frames are told apart by their lists and files, so that those of another motion differ.
    """
    if protocol == "next":
        return NextFrames(session.dataset).dataset.fingerprint()[:6]
    return session.consistency.mark


def consistency_table(found: Mapping[Protocol, Counts], absent: Absent) -> ConsistencyTable:
    """TC and CA of every class and protocol; means over the scored classes.

    Args:
        found: counts by protocol, see `count_pairs`.
        absent: how a class without pixels counts, see `rgbt.metrics.scores`.
    """
    scores, right = (
        {
            protocol: OF_PAIRS[HEADLINES[protocol][place]](counts.by_region(), absent)
            for protocol, counts in found.items()
        }
        for place in (0, 1)
    )
    like = next(iter(found.values()))
    return ConsistencyTable(
        names=like.classes,
        tc={protocol: tuple(map(float, values)) for protocol, values in scores.items()},
        ca={protocol: tuple(map(float, values)) for protocol, values in right.items()},
        mean_tc={each: float(class_mean(values, like.scored)) for each, values in scores.items()},
        mean_ca={each: float(class_mean(values, like.scored)) for each, values in right.items()},
        unscored=like.unscored,
    )


def consistency_values(table: ConsistencyTable) -> dict[str, float]:
    """The means as metrics of a run, as fractions: "TC/aligned", "CA/aligned", ..."""
    means = {TC: table.mean_tc, CA: table.mean_ca}
    return {
        consistency(score, protocol): by_protocol[protocol]
        for protocol in table.tc
        for score, by_protocol in means.items()
    }


def consistency_title(pairs: Pairs, label: str, dataset: str) -> str:
    """Title of the table: what was measured, on which second frames."""
    protocol, counts = next(iter(pairs.counts.items()))
    frames = next(frames for frames, protocols in PROTOCOLS.items() if protocol in protocols)
    views = counts.partition.partition("-")[2] or "published"
    return f"Consistency of {label} ({dataset}, {counts.split}; {frames}: {views})"
