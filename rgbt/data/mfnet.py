"""Read MFNet and data sets in its layout: split lists, images, labels, time of day by name."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.file_dataset import DAY_OR_NIGHT, FileDataset
from rgbt.data.files import read_array
from rgbt.data.images import PairReader
from rgbt.data.labels import indices
from rgbt.data.patterns import FrameFiles, Patterns
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.ranges import Colour, Names, NumClasses, Text

Layout = Literal["packed", "folders"]

# Class -> its colour, in the order of the indices.
COLOURS = {
    "unlabeled": (0, 0, 0),
    "car": (64, 0, 128),
    "person": (64, 64, 0),
    "bike": (0, 128, 192),
    "curve": (0, 0, 192),
    "car_stop": (128, 128, 0),
    "guardrail": (64, 64, 128),
    "color_cone": (192, 128, 128),
    "bump": (192, 64, 0),
}
CLASSES, PALETTE = tuple(COLOURS), tuple(COLOURS.values())
LAYOUTS: dict[Layout, tuple[str, str, str]] = {
    "packed": ("images/{name}.png", "images/{name}.png", "labels/{name}.png"),
    "folders": ("RGB/{name}.png", "Thermal/{name}.png", "Label/{name}.png"),
}
SPLITS: dict[str, str | tuple[str, ...]] = {
    split: f"{split}.txt" for split in ("train", "val", "test", "test_day", "test_night")
}

MIRRORED = "_flip"
NEXT = "next"


class MFNet(FileDataset):
    """Reads RGB-thermal street scenes with labels, in the layout of the MFNet archive.

    Layouts (NAME is a line of a split list, five digits and D for day or N for night):
        packed:  images/NAME.png with channels R, G, B, thermal, and labels/NAME.png
        folders: RGB/NAME.png, Thermal/NAME.png (one channel, or three equal ones), Label/NAME.png

    A name NAME_flip in a list is read from its own files; nothing is mirrored here. A split without
    a list of its own, such as train_day, has the images by day, or at night, of another.

    Source: MFNet (Ha et al., IROS 2017), archive ir_seg_dataset; the folders layout is the one of
    the SpatialSeg and Temporal downloads. Class 0 is trained and scored, as in published tables.
    """

    images = PairReader(layouts=tuple(Patterns.of(*layout[:2]) for layout in LAYOUTS.values()))
    mirrored = MIRRORED

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "mfnet",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        background: Names = ("unlabeled",),
        splits: dict[Text, Text | Names] = SPLITS,
        layout: Literal["auto"] | Layout = "auto",
    ) -> None:
        super().__init__(root, name, num_classes, classes, palette, background=background)
        found, listed = [], []
        for kind, texts in LAYOUTS.items():
            if layout not in ("auto", kind):
                continue
            folders = sorted({text.partition("/")[0] for text in texts})
            listed.append("+".join(folders))
            if all((self.root / folder).is_dir() for folder in folders):
                found.append(kind)
        if not found:
            wanted = " or ".join(listed)
            raise InputError(f"dataset.root: '{root}' does not hold the folders {wanted}.")
        self.layout = found[0]
        self.patterns = Patterns.of(*LAYOUTS[self.layout])
        self.codes = indices(num_classes)
        self.use_lists(splits)

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`."""
        return self.patterns.frame(self.root, name, {"name": name})

    def check_split(self, split: str) -> None:
        """Refuse a split that is neither one of `splits` nor the day or the night of one."""
        if self._whole(split) is None:
            super().check_split(split)

    def listed(self, split: str) -> tuple[str, ...]:
        """Return the names of a known split; those by time of day are taken from the whole."""
        whole = self._whole(split)
        if whole is None:
            return self.lines(split)
        names = self.lines(whole)
        nights = self.nights(names) or ()
        is_wanted = split.endswith("_night")
        return tuple(n for n, night in zip(names, nights, strict=False) if night == is_wanted)

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Say which names end in N, not D; None if no name does, InputError if only some do."""
        times = [name.removesuffix(MIRRORED)[-1:] for name in names]
        without = [name for name, time in zip(names, times, strict=True) if time not in ("D", "N")]
        if without and len(without) < len(names):
            raise InputError(
                f"the name '{without[0]}' in {self.root} states no time of day, as others do."
            )
        return None if without else tuple(time == "N" for time in times)

    def repeats(self, split: str) -> bool:
        """Say that lists by time of day only repeat names of others, and need not exist."""
        return super().repeats(split) and not self.has(split)

    def _whole(self, split: str) -> str | None:
        """The split whose images by day or night are wanted, where these have no list."""
        whole = split.rpartition("_")[0]
        is_part = split.endswith(DAY_OR_NIGHT) and split not in self.splits and whole in self.splits
        return whole if is_part else None


class NextFrames:
    """Reads the second frames of a data set, and where their points are in the first frames.

    The folder `next` beside the images has the same layout and names, one moment later, and
    flow/NAME.npy, (H, W, 2) float32: for every pixel of the second frame, how many (rows, columns)
    further the same point lies in the first; NaN if it is hidden there or outside. `synth` writes
    it (``dataset.ego_forward_m``); any data set in MFNet's layout may hold one.

    Attributes:
        dataset: reader of the second frames.

    Raises:
        InputError: the data set of the `first` frames has no second ones, or another layout.
    """

    def __init__(self, first: LabelledDataset) -> None:
        first = reader_of(first)
        root = first.root / NEXT
        if not isinstance(first, MFNet) or not (root / "flow").is_dir():
            raise InputError(
                f"{first.name} ({first.root}) has no second frames: expected MFNet's layout with "
                f"the folder {NEXT}/ of images, labels and flow. dataset=synth writes it with "
                "dataset.ego_forward_m=0.5; frames=virtual does not require it."
            )
        self.dataset = MFNet(
            str(root),
            name=f"{first.name}/{NEXT}",
            num_classes=first.num_classes,
            classes=first.classes,
            background=first.background,
            palette=first.palette,
            splits={**first.splits, **first.files_of},
            layout=first.layout,
        )

    def flow(self, name: str, image_hw: tuple[int, int]) -> NDArray[np.float32]:
        """Read the offset (H, W, 2) in rows and columns of pixels of the second frame to the first.

        NaN if the point was not visible there. InputError: no flow, or not of the size `image_hw`.
        """
        path = self._path(name)
        flow = read_array(path, "rows and columns")
        if flow.dtype.kind != "f" or flow.shape != (*image_hw, 2):
            raise InputError(
                f"{path}: expected real numbers of shape {(*image_hw, 2)} (rows, columns) like its "
                f"frame, got {flow.dtype} of shape {flow.shape}."
            )
        return np.asarray(flow, np.float32)

    def source(self, name: str, image_hw: tuple[int, int]) -> tuple[NDArray[np.int64], ...]:
        """Return the position of each pixel of the second frame in the first frame.

        Returns:
            rows and columns (H, W) int64, nearest pixels; -1 if the point was not visible.

        Raises:
            InputError: as `flow`, or a flow that leads out of the image.
        """
        flow = self.flow(name, image_hw)
        grid = np.moveaxis(np.indices(image_hw), 0, -1)
        seen = np.isfinite(flow[..., 0]) & np.isfinite(flow[..., 1])
        first_yx = np.rint(np.where(seen[..., None], grid + flow, 0)).astype(np.int64)
        if (first_yx < 0).any() or (first_yx >= image_hw).any():
            raise InputError(
                f"{self._path(name)} points outside the first frame of {image_hw[0]}x{image_hw[1]} "
                "pixels; points that were not visible there must be NaN."
            )
        first_yx[~seen] = -1
        return first_yx[..., 0], first_yx[..., 1]

    def _path(self, name: str) -> Path:
        return self.dataset.root / "flow" / f"{name}.npy"
