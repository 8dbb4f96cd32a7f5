"""Both frames of every pair as images for any method, and its predictions of them read back.

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
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rgbt.checks import InputError
from rgbt.config.common_options import PredictionFormatOptions
from rgbt.data.predictions import Affixes, FormatOptions, PredictionReader, prediction_paths
from rgbt.data.video import FramesInOrder
from rgbt.dataset import LabelledDataset
from rgbt.engine.progress import progress
from rgbt.evaluation.images import write_png
from rgbt.evaluation.pair_frames import Pairing, PairSource, frame_pairs
from rgbt.evaluation.temporal_consistency import Pairs, count_predicted, to_bytes
from rgbt.files.plain_files import inside
from rgbt.metrics import pair_list
from rgbt.metrics.measurement import Measurement
from rgbt.metrics.pair_list import PAIR_LIST, Frames, ListedPair, PairList, second_name
from rgbt.types import Batch

CPU = torch.device("cpu")


def list_pairs(source: PairSource, split: str, frames: Frames) -> PairList:
    """The pairs of a split; InputError without second frames, or with two images of one name."""
    pairing = Pairing(frames)
    pairing.check(source)
    listed, sets = source.dataset.names(split), tuple(source.consistency.sets)
    names = tuple(dict.fromkeys(listed))
    pairs = []
    for name in names:
        if frames == "next":
            pairs.append(ListedPair(name, second_name(name, frames, 0), 1))
            continue
        for number in range(len(sets)):
            (angles,) = source.consistency.angles(number, [listed.index(name)]).tolist()
            pairs.append(ListedPair(name, second_name(name, frames, number), number + 1, *angles))
    if taken := {pair.second for pair in pairs} & set(names):
        raise InputError(f"image '{min(taken)}' has the name of a second frame; rename it.")
    return PairList(
        format="rgbt pairs 1",
        complete=True,
        dataset=source.dataset.fingerprint(),
        name=source.dataset.name,
        split=split,
        frames=frames,
        views=pairing.mark(source, pairing.protocols[0]) or "published",
        sets=sets if frames == "virtual" else (),
        pairs=tuple(pairs),
    )


def write_images(source: PairSource, split: str, frames: Frames, out: Path) -> PairList:
    """Write both frames of every pair of a split; InputError where `out` holds other files."""
    listed = list_pairs(source, split, frames)
    same = (out / PAIR_LIST).is_file() and replace(
        pair_list.read_list(out), complete=True
    ) == listed
    if not same and out.exists() and (out.is_file() or any(out.iterdir())):
        raise InputError(f"export={out} holds other files or other pairs; choose an empty folder.")
    out.mkdir(parents=True, exist_ok=True)
    replace(listed, complete=False).write(out)
    with progress() as display:
        task = display.add_task(f"{split} pairs", total=len(listed.images), note="images")
        for pairs in frame_pairs(source, split, frames, CPU):
            if pairs.number == 0:
                _write(pairs.first, pairs.first.name, out)
                display.advance(task, len(pairs.names))
            _write(pairs.second, pairs.names, out)
            display.advance(task, len(pairs.names))
    listed.write(out)
    return listed


def _write(batch: Batch, names: Sequence[str], out: Path) -> None:
    for name, rgb, thermal in zip(names, batch.rgb, batch.thermal, strict=True):
        write_png(inside(out / "rgb" / f"{name}.png", out), to_bytes(rgb)[..., ::-1])
        write_png(inside(out / "thermal" / f"{name}.png", out), to_bytes(thermal)[..., 0])


class FolderPredictions:
    """Frames `names` predicted by any method, read from its label images in `folder`.

    InputError: files are missing.
    """

    def __init__(
        self, folder: Path, dataset: LabelledDataset, names: Sequence[str], given: FormatOptions
    ) -> None:
        self._paths = prediction_paths(folder, names, given.affixes)
        missing = [path for path in self._paths.values() if not path.is_file()]
        if missing:
            raise InputError(f"predictions={missing[0]} and {len(missing) - 1} more do not exist.")
        self._reader = PredictionReader(dataset.classes, dataset.palette, given)

    def __call__(self, batch: Batch, names: Sequence[str]) -> Tensor:
        """See `rgbt.evaluation.pair_frames.Predict`; InputError: a file of another size."""
        wanted, maps = tuple(batch.label.shape[1:]), []
        for path in (self._paths[name] for name in names):
            classes = self._reader.read(path)
            if classes.shape != wanted:
                raise InputError(f"{path}: size {classes.shape}, but its image has {wanted}.")
            maps.append(torch.from_numpy(np.ascontiguousarray(classes)))
        return torch.stack(maps)


def count_predictions(
    folder: Path,
    exported: Path,
    options: PredictionFormatOptions,
    overrides: Sequence[str],
    split: str,
    pairing: Pairing,
) -> tuple[Pairs, PairSource]:
    """Count the label images in `folder` of the images that were written to `exported`."""
    source = PairSource.compose(overrides)
    if pairing.frames == "video":
        names = FramesInOrder(source.dataset, split).names(split)
    else:
        wanted = list_pairs(source, split, pairing.frames)
        pair_list.check_same(pair_list.read_list(exported), wanted)
        names = wanted.images
    affixes = Affixes(options.prefix, options.suffix)
    given = FormatOptions(form=options.format, palette=options.palette, affixes=affixes)
    predict = FolderPredictions(folder, source.dataset, names, given)
    measurement = Measurement(
        dataset=source.dataset.fingerprint(),
        split=split,
        view="rgbt",
        partition=source.regions.name,
        absent=source.regions.absent,
        dataset_name=source.dataset.name,
    )
    kept = pairing.pictured(source, split)
    return count_predicted(source, predict, measurement, pairing, CPU, kept), source
