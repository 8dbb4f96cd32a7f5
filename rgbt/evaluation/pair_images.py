"""Both frames of every pair as images for any method, and its predictions of them read back.

`write_images` writes

    rgb/NAME.png  thermal/NAME.png                first frames, 8 bit, as the data set reads them
    rgb/NAME_view1.png  thermal/NAME_view1.png    second frames of the first set of views, ...
    pairs.json                                    the pairs, their angles, what they are made of

at the size of the files. The method predicts NAME.png and NAME_view1.png, ..., of the same size;
on true second frames NAME_next.png.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rgbt.checks import InputError
from rgbt.data.next_frames import NextFrames
from rgbt.data.prediction_files import OVERLAY, Affixes, find_affixes
from rgbt.data.prediction_format import FormatOptions, recognise_format
from rgbt.engine.progress import progress
from rgbt.evaluation.images import write_png
from rgbt.evaluation.pair_frames import next_frames, virtual_frames
from rgbt.evaluation.pair_list import PairSource, list_pairs
from rgbt.metrics.pair_list import (
    PAIR_LIST,
    Frames,
    PairList,
    check_same,
    read_list,
    second_name,
)
from rgbt.types import Batch

CPU = torch.device("cpu")
SHOWN = 3
"""Most files that a message names."""


def write_images(source: PairSource, split: str, frames: Frames, out: Path) -> PairList:
    """Write both frames of every pair of a split, with a progress bar.

    Raises:
        InputError: `out` holds other files, or an image cannot be read.
    """
    listed = list_pairs(source, split, frames)
    _check_out(out, listed)
    out.mkdir(parents=True, exist_ok=True)
    replace(listed, complete=False).write(out)
    with progress() as display:
        task = display.add_task(f"{split} pairs", total=len(listed.images), note="images")
        for batch, names in _batches(source, split, frames):
            for name, rgb, thermal in zip(names, batch.rgb, batch.thermal, strict=True):
                write_png(out / "rgb" / f"{name}.png", _bytes(rgb)[..., ::-1])
                write_png(out / "thermal" / f"{name}.png", _bytes(thermal)[..., 0])
                display.advance(task)
    listed.write(out)
    return listed


def _batches(
    source: PairSource, split: str, frames: Frames
) -> Iterator[tuple[Batch, tuple[str, ...]]]:
    """All frames with the names of their images."""
    if frames == "next":
        for first, second in next_frames(source, NextFrames(source.dataset), split, CPU):
            yield first, first.name
            yield second, tuple(second_name(name, frames, 0) for name in second.name)
        return
    for each in virtual_frames(source, split, CPU):
        if each.number == 0:
            yield each.batch, each.batch.name
        yield each.second, tuple(second_name(name, frames, each.number) for name in each.batch.name)


def _bytes(image: Tensor) -> NDArray[np.uint8]:
    """(H, W, C) of an image (C, H, W) in [0, 1]."""
    return (255 * image).round().to(torch.uint8).permute(1, 2, 0).numpy()


def _check_out(out: Path, listed: PairList) -> None:
    """Refuse a folder with other files, which would be mixed with the images or overwritten."""
    if out.exists() and not out.is_dir():
        raise InputError(f"export={out} is a file; choose a folder.")
    if not out.is_dir() or not any(out.iterdir()):
        return
    if not (out / PAIR_LIST).is_file():
        raise InputError(f"export={out} holds other files; choose an empty folder.")
    if replace(read_list(out), complete=True) != listed:
        raise InputError(f"export={out} holds other pairs ({PAIR_LIST}); choose another folder.")


class FolderFrames:
    """Single frames predicted by any method, read from its label images NAME.png.

    Args:
        folder: of the predictions.
        source: data set.
        names: of the frames, all of which must be there.
        given: what the user says about the files, see `rgbt.data.prediction_format`.

    Attributes:
        sentence: what the files were read as.

    Raises:
        InputError: files are missing or of several kinds.
    """

    device = CPU

    def __init__(
        self,
        folder: Path,
        source: PairSource,
        names: Sequence[str],
        given: FormatOptions = FormatOptions(),  # noqa: B008 - frozen
    ) -> None:
        self._folder = folder
        self._affixes = _affixes_of_all(folder, names, given.affixes)
        paths = map(self._path, names)
        dataset = source.dataset
        self._reader, said = recognise_format(paths, dataset.classes, dataset.palette, given)
        self.sentence = " ".join(filter(None, (said, self._affixes.sentence)))

    def first(self, batch: Batch) -> Tensor:
        """See `rgbt.evaluation.pair_scenes.PairPredictor`."""
        return self._read(batch.name, batch)

    def second(self, batch: Batch, number: int) -> Tensor:  # noqa: ARG002 - frames of one video
        """See `rgbt.evaluation.pair_scenes.PairPredictor`."""
        return self._read(batch.name, batch)

    def _read(self, names: Sequence[str], batch: Batch) -> Tensor:
        wanted, maps = tuple(batch.label.shape[1:]), []
        for path in map(self._path, names):
            classes = self._reader.read(path)
            if classes.shape != wanted:
                sizes = ["x".join(map(str, each)) for each in (classes.shape, wanted)]
                raise InputError(
                    f"{path} is {sizes[0]} pixels but its image is {sizes[1]}; write predictions "
                    "at the size of the exported images."
                )
            maps.append(torch.from_numpy(np.ascontiguousarray(classes)))
        return torch.stack(maps)

    def _path(self, name: str) -> Path:
        return self._folder / f"{self._affixes.file_stem(name)}.png"


class FolderPairs(FolderFrames):
    """Both frames of exported pairs predicted by any method.

    Args:
        folder: holds NAME.png and NAME_view1.png, ..., or NAME_next.png.
        source: data set and views, which must be those of the export.
        listed: the list of the export.
        wanted: split and frames that are counted.
        given: see `FolderFrames`.

    Raises:
        InputError: the export is of other images or incomplete, or files are missing, foreign or
            of several kinds.
    """

    def __init__(
        self,
        folder: Path,
        source: PairSource,
        listed: PairList,
        wanted: PairList,
        given: FormatOptions = FormatOptions(),  # noqa: B008 - frozen
    ) -> None:
        check_same(listed, wanted)
        self._frames = wanted.frames
        super().__init__(folder, source, wanted.images, given)
        _check_foreign(folder, wanted.images, self._affixes)

    def second(self, batch: Batch, number: int) -> Tensor:
        """See `rgbt.evaluation.pair_scenes.PairPredictor`."""
        return self._read([second_name(name, self._frames, number) for name in batch.name], batch)


def _stems_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.png")}


def _affixes_of_all(folder: Path, names: Sequence[str], given: Affixes) -> Affixes:
    """How the files are named, which must include one of every image."""
    if not folder.is_dir():
        raise InputError(
            f"predictions={folder}: there is no such folder; give the one with the predictions."
        )
    there = _stems_in(folder)
    affixes = find_affixes(there, names, given)
    stems = [affixes.file_stem(name) for name in names]
    missing = [stem for stem in stems if stem not in there]
    if missing:
        raise InputError(
            f"{folder} lacks the predictions of {len(missing)} of {len(names)} images "
            f"({_listed(missing)}); predict every image."
        )
    return affixes


def _check_foreign(folder: Path, names: Sequence[str], affixes: Affixes) -> None:
    """Refuse a folder with PNG files of other images than those of the export."""
    own = {*map(affixes.file_stem, names), *(f"{name}{OVERLAY}" for name in names)}
    foreign = sorted(_stems_in(folder) - own)
    if foreign:
        raise InputError(
            f"{folder} holds {len(foreign)} PNG files of no exported image ({_listed(foreign)}); "
            "remove them, or name the export that they belong to with pairs=FOLDER."
        )


def _listed(names: Sequence[str]) -> str:
    shown = ", ".join(f"{name}.png" for name in names[:SHOWN])
    return shown if len(names) <= SHOWN else f"{shown} and {len(names) - SHOWN} more"
