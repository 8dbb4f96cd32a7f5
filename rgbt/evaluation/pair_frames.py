"""Batches of both frames of every scene of a split, on which TC and CA are measured.

The second frame is a virtual view of the first (frames=virtual), or a true one (frames=next).
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import zip_longest
from typing import NamedTuple

import torch
from torch import Tensor

from rgbt.build.requirements import check_requirements
from rgbt.checks import InputError
from rgbt.data.loaders import eval_batches
from rgbt.data.next_frames import NextFrames
from rgbt.evaluation.prediction import EvaluationData
from rgbt.geometry.warp import Warp
from rgbt.metrics.pair_list import Frames
from rgbt.types import Batch


def check_frames(data: EvaluationData, frames: Frames) -> None:
    """Refuse to measure without second frames.

    Raises:
        InputError: the data set has none, there are no sets of views, or they paint the background
            of a data set without one.
    """
    if frames == "next":
        NextFrames(data.dataset)
    elif frames == "virtual" and not data.consistency.sets:
        raise InputError(
            "consistency.sets is empty. Name sets of angles, such as "
            "consistency.sets=[released_1], or choose consistency=views."
        )
    elif frames == "virtual":
        check_requirements({"consistency": data.consistency, "dataset": data.dataset}, {})


class VirtualFrames(NamedTuple):
    """A batch of scenes and its virtual second frames.

    Attributes:
        batch: first frames, on the device.
        number: of the set of views, from 0.
        angles: (B, 3) float64, yaw, pitch and roll in degrees.
        warp: from the first to the second frames, at the size of the images.
        second: the second frames.
    """

    batch: Batch
    number: int
    angles: Tensor
    warp: Warp
    second: Batch


def virtual_frames(
    data: EvaluationData, split: str, device: torch.device
) -> Iterator[VirtualFrames]:
    """Every batch of a split with each set of views in turn.

    Raises:
        InputError: the camera is one of images of another shape.
    """
    names, views = data.dataset.names(split), data.consistency.view
    # A name that the list holds twice has the views of its first position.
    position = dict(zip(reversed(names), reversed(range(len(names))), strict=True))
    for batch in eval_batches(data.dataset, split, data.transform, data.loading):
        moved = batch.to(device)
        indices = [position[name] for name in batch.name]
        for number in range(len(data.consistency.sets)):
            angles = data.consistency.angles(number, indices).to(device)
            try:
                warp = views.warp(angles, (moved.rgb.shape[2], moved.rgb.shape[3]))
            except InputError as error:
                raise InputError(f"consistency.view, image '{batch.name[0]}': {error}") from error
            yield VirtualFrames(moved, number, angles, warp, views.batch(moved, warp))


def next_frames(
    data: EvaluationData, after: NextFrames, split: str, device: torch.device
) -> Iterator[tuple[Batch, Batch]]:
    """Batches of the first and of the real second frames of a split, on the device.

    Raises:
        InputError: a frame is missing, or the two of a scene differ in size.
    """
    pairs = zip_longest(
        eval_batches(data.dataset, split, data.transform, data.loading),
        eval_batches(after.dataset, split, data.transform, data.loading),
    )
    for batch, later in pairs:
        names = [() if each is None else each.name for each in (batch, later)]
        if names[0] != names[1]:
            raise InputError(
                f"both frames of a scene must be listed in {split} and readable, but "
                f"{data.dataset.root} has {', '.join(names[0]) or 'no further image'} where "
                f"{after.dataset.root} has {', '.join(names[1]) or 'no further image'}."
            )
        if batch.label.shape != later.label.shape:
            sizes = [" x ".join(map(str, each.label.shape[1:])) for each in (batch, later)]
            raise InputError(
                f"both frames of a scene must have the same size, but '{names[0][0]}' has "
                f"{sizes[0]} pixels in {data.dataset.root} and {sizes[1]} in "
                f"{after.dataset.root}."
            )
        yield batch.to(device), later.to(device)
