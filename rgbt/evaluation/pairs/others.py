"""Export both frames of every pair as images for any method, and count its predictions of them.

`write_images` writes, at the size of the files of the data set,

    rgb/NAME.png  thermal/NAME.png                first frames, 8 bit, as the data set reads them
    rgb/NAME_view1.png  thermal/NAME_view1.png    second frames of the first set of views, ...
    pairs.json                                    the pairs, their angles, what they are made of

The method predicts NAME.png and NAME_view1.png, ..., of the same size; of real second frames
NAME_next.png.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.data.predictions import PredictionReader
from rgbt.data.video import frames_in_order
from rgbt.evaluation.images import write_png
from rgbt.evaluation.pairs.count import CountedPairs, count_predicted, to_bytes
from rgbt.evaluation.pairs.frames import FramePairs, frame_pairs
from rgbt.evaluation.pairs.scenes import Predict
from rgbt.files.plain_files import inside
from rgbt.metrics import pair_list
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.pair_list import PAIR_LIST, ListedPair, PairList, second_name
from rgbt.terminal import progress
from rgbt.types import Batch

CPU = torch.device("cpu")


def list_pairs(pairs: FramePairs) -> PairList:
    """List the pairs; InputError: an image has the name of a second frame."""
    listed, sets = pairs.dataset.names(pairs.split), tuple(pairs.views.sets)
    found = []
    for name in dict.fromkeys(listed):
        if pairs.frames == "next":
            found.append(ListedPair(name, second_name(name, "next", 0), 1))
            continue
        for number in range(len(sets)):
            (angles,) = pairs.views.angles(number, [listed.index(name)]).tolist()
            second = second_name(name, "virtual", number)
            found.append(ListedPair(name, second, number + 1, *angles))
    if taken := {pair.second for pair in found} & set(listed):
        raise InputError(f"image '{min(taken)}' has the name of a second frame; rename it.")
    return PairList(
        format="rgbt pairs 1",
        complete=True,
        dataset=pairs.dataset.fingerprint(),
        name=pairs.dataset.name,
        split=pairs.split,
        frames=pairs.frames,
        views=pairs.mark(pairs.protocols[0]) or "published",
        sets=sets if pairs.frames == "virtual" else (),
        pairs=tuple(found),
    )


def write_images(pairs: FramePairs, out: Path) -> PairList:
    """Write both frames of every pair; InputError where `out` holds other files."""
    listed = list_pairs(pairs)
    is_same = (out / PAIR_LIST).is_file()
    is_same = is_same and replace(pair_list.read_list(out), complete=True) == listed
    if not is_same and out.exists() and (out.is_file() or any(out.iterdir())):
        raise InputError(f"export={out} holds other files or other pairs; choose an empty folder.")
    out.mkdir(parents=True, exist_ok=True)
    replace(listed, complete=False).write(out)
    with progress() as display:
        task = display.add_task(f"{pairs.split} pairs", total=len(listed.images), note="images")
        for batch in frame_pairs(pairs, CPU):
            if batch.number == 0:
                _write(batch.first, batch.first.name, out)
            _write(batch.second, batch.names, out)
            display.advance(task, len(batch.names) * (2 if batch.number == 0 else 1))
    listed.write(out)
    return listed


def _write(batch: Batch, names: Sequence[str], out: Path) -> None:
    for name, rgb, thermal in zip(names, batch.rgb, batch.thermal, strict=True):
        write_png(inside(out / "rgb" / f"{name}.png", out), to_bytes(rgb)[..., ::-1])
        write_png(inside(out / "thermal" / f"{name}.png", out), to_bytes(thermal)[..., 0])


def folder_predictions(
    folder: Path, pairs: FramePairs, names: Sequence[str], given: PredictionFormatOptions
) -> Predict:
    """Return a function that reads predictions of any method, label images in `folder`.

    InputError: files of `names` are missing; the function: one has another size than its image.
    """
    reader = PredictionReader(pairs.dataset.classes, pairs.dataset.palette, *given.form)
    paths = {name: reader.path(folder, name) for name in names}
    missing = [path for path in paths.values() if not path.is_file()]
    if missing:
        raise InputError(f"predictions={missing[0]} and {len(missing) - 1} more do not exist.")

    def predict(batch: Batch, names: Sequence[str]) -> Tensor:
        wanted, maps = tuple(batch.label.shape[1:]), []
        for name in names:
            classes = reader.read(paths[name])
            if classes.shape != wanted:
                raise InputError(
                    f"{paths[name]}: size {classes.shape}, but its image has {wanted}."
                )
            maps.append(torch.from_numpy(np.ascontiguousarray(classes)))
        return torch.stack(maps)

    return predict


def count_predictions(
    folder: Path, exported: Path, options: PredictionFormatOptions, pairs: FramePairs
) -> CountedPairs:
    """Count the label images in `folder` of the images that were written to `exported`.

    InputError: predictions are missing or of other images than those of `pairs`.
    """
    if pairs.frames == "video":
        names = tuple(chain.from_iterable(frames_in_order(pairs.dataset, pairs.split)))
    else:
        wanted = list_pairs(pairs)
        pair_list.check_same(pair_list.read_list(exported), wanted)
        names = wanted.images
    predict = folder_predictions(folder, pairs, names, options)
    measurement = Measurement(
        dataset=pairs.dataset.fingerprint(),
        split=pairs.split,
        view="rgbt",
        partition=pairs.regions.name,
        absent=pairs.regions.absent,
        dataset_name=pairs.dataset.name,
    )
    return count_predicted(pairs, predict, measurement, CPU, pairs.pictured)
