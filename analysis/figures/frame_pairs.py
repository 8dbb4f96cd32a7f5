"""Read exported pairs of frames and what methods predict of both, and compare the predictions.

Pixels count as in TC (`rgbt.metrics.pairs`, protocols aligned and next).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from analysis.figures.inputs import FigureInput
from rgbt.checks import InputError
from rgbt.data.files import decode, read_rgb
from rgbt.data.mfnet import NextFrames
from rgbt.data.predictions import FormatOptions, PredictionReader
from rgbt.metrics.pair_list import ListedPair, PairList, read_list
from rgbt.types import IGNORE

if TYPE_CHECKING:
    from rgbt.dataset import LabelledDataset
    from rgbt.types import Sample

Bytes = NDArray[np.uint8]
Mask = NDArray[np.bool_]

PREDICTIONS = "label:folder of predictions of exported pairs, with commas between methods"
EXPORT = "the folder that rgbt consistency export=... wrote"


class Frame(NamedTuple):
    """One frame with labels: (H, W, 3), (H, W) and (H, W) uint8; 255: no label."""

    rgb: Bytes
    thermal: Bytes
    label: Bytes


class Followed(NamedTuple):
    """Where the pixels of a second frame come from.

    Attributes:
        rows: (H, W) int64 in the first frame.
        columns: (H, W) int64 in the first frame.
        compared: (H, W) bool: seen in the first frame, and labelled in the second.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    compared: Mask


@dataclass(frozen=True)
class FramePair:
    """A pair of frames and the predictions of M methods.

    Attributes:
        name: of the first frame.
        frames: both.
        predictions: (H, W) class indices, of both frames, for each method.
        differ: (H, W) bool for each method, pixels of the second frame whose two predictions
            differ; of `compared` alone.
        compared: (H, W) bool, pixels that count.
    """

    name: str
    frames: tuple[Frame, Frame]
    predictions: tuple[tuple[Bytes, Bytes], ...]
    differ: tuple[Mask, ...]
    compared: Mask

    @property
    def shares(self) -> tuple[float, ...]:
        """Percent of the compared pixels that differ, for each method; NaN where none is."""
        count = int(self.compared.sum())
        return tuple(100 * int(each.sum()) / count if count else np.nan for each in self.differ)


class Pairs:
    """The pairs of an export, with the predictions of methods.

    Args:
        given: names the export, the data set and the methods.

    Raises:
        InputError: an export of other images, or an unfinished one.
    """

    def __init__(self, given: FigureInput) -> None:
        self._folder = Path(given.need("pairs", EXPORT)).expanduser()
        self._dataset: LabelledDataset = given.dataset
        self._listed = read_list(self._folder)
        self._after = NextFrames(self._dataset) if self._listed.frames == "next" else None
        self._views: Any = None if self._after else given.consistency
        _check(self._listed, self._dataset, self._second_frames())
        named = given.named("methods", PREDICTIONS)
        self.methods = {label: Path(place).expanduser() for label, place in named.items()}
        self._format = FormatOptions(
            form=given.get("format", "index"), palette=given.get("palette", "dataset")
        )
        number = given.get("view_set", 1)
        self.listed = {each.first: each for each in self._listed.pairs if each.set == number}
        if not self.listed:
            sets = sorted({each.set for each in self._listed.pairs})
            raise InputError(f"view_set={number}: the export has the sets {sets}.")

    @property
    def second(self) -> str:
        """What second frames are called."""
        return "next frame" if self._after else "synthesised"

    def _second_frames(self) -> str:
        """The mark of the second frames of the data set and the views."""
        if self._after:
            return self._after.dataset.fingerprint()[:6]
        return self._views.mark or "published"

    def read(self, name: str) -> FramePair:
        """The pair whose first frame is called `name`."""
        pair, sample = self.listed[name], self._dataset.read(name)
        if sample.label is None:
            raise InputError(f"names: '{name}' has no label; choose images that are labelled.")
        first = Frame(sample.rgb, sample.thermal, sample.label)
        label, followed = self._follow(pair, sample)
        second = Frame(
            read_rgb(self._folder / "rgb" / f"{pair.second}.png"),
            np.asarray(decode(self._folder / "thermal" / f"{pair.second}.png"), np.uint8),
            label,
        )
        predictions, differ = [], []
        for folder in self.methods.values():
            first_map, second_map = self._predicted(folder, (name, pair.second), label)
            predictions.append((first_map, second_map))
            brought = first_map[followed.rows, followed.columns]
            differ.append((brought != second_map) & followed.compared)
        return FramePair(
            name, (first, second), tuple(predictions), tuple(differ), followed.compared
        )

    def _follow(self, pair: ListedPair, sample: Sample) -> tuple[Bytes, Followed]:
        """The label of the second frame, and where its pixels come from."""
        assert sample.label is not None, "the caller has checked it"
        shape = sample.label.shape
        if self._after:
            label = self._after.dataset.read(pair.first).label
            assert label is not None, "second frames of MFNet's layout have labels"
            rows, columns = self._after.source(pair.first, shape)
            seen = (rows >= 0) & (label != IGNORE)
            return label, Followed(rows.clip(0), columns.clip(0), seen)
        import torch

        view = self._views.view
        angles = torch.tensor([[pair.yaw, pair.pitch, pair.roll]], dtype=torch.float64)
        warp = view.warp(angles, shape)
        label = warp.nearest(torch.from_numpy(sample.label)[None], view.outside_label)[0].numpy()
        places = torch.arange(label.size).view(1, *shape)
        rows, columns = np.divmod(warp.nearest(places, 0)[0].numpy(), shape[1])
        seen = warp.inside()[0].numpy() & (label != IGNORE)
        return label, Followed(rows, columns, seen)

    def _predicted(self, folder: Path, names: tuple[str, str], label: Bytes) -> list[Bytes]:
        """The predictions of both frames."""
        paths = [folder / f"{name}.png" for name in names]
        for path in paths:
            if not path.is_file():
                raise InputError(
                    f"methods: there is no prediction {path}; predict every image of "
                    f"{self._folder}, for example with rgbt predict input={self._folder} "
                    f"out={folder}."
                )
        dataset = self._dataset
        reader = PredictionReader(dataset.classes, dataset.palette, self._format)
        found = [reader.read(path) for path in paths]
        for path, each in zip(paths, found, strict=True):
            if each.shape != label.shape:
                sizes = ["x".join(map(str, shape)) for shape in (each.shape, label.shape)]
                raise InputError(
                    f"{path} is {sizes[0]} pixels but its image is {sizes[1]}; write predictions "
                    "at the size of the exported images."
                )
        return found


def _check(listed: PairList, dataset: LabelledDataset, second_frames: str) -> None:
    if not listed.complete:
        raise InputError(
            f"the export of {listed.name} was interrupted; rerun its command, then predict again."
        )
    if listed.dataset != dataset.fingerprint():
        raise InputError(
            f"the pairs were exported from other images ({listed.name}, {listed.dataset[:8]}) than "
            f"those of {dataset.name} ({dataset.fingerprint()[:8]}); name the data set of the "
            "export."
        )
    if listed.views != second_frames:
        raise InputError(
            f"the pairs were exported with other second frames ({listed.views}) than those of the "
            f"settings ({second_frames}); give the consistency settings of the export."
        )
