"""Read PST900: RGB-thermal images of mines and tunnels, with four objects of search and rescue."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset, SplitNames
from rgbt.data.images import PairReader
from rgbt.data.labels import indices
from rgbt.data.patterns import FrameFiles, Patterns
from rgbt.ranges import Colour, Names, NumClasses, Text

Bags = tuple[Annotated[int, Interval(ge=0, le=10**6)], ...]
# Class -> its colour, in the order of the indices.
COLOURS = {
    "background": (0, 0, 0),
    "fire_extinguisher": (0, 0, 255),
    "backpack": (0, 255, 0),
    "hand_drill": (255, 0, 0),
    "survivor": (255, 255, 255),
}
CLASSES, PALETTE = tuple(COLOURS), tuple(COLOURS.values())
PATTERNS = tuple(f"{{part}}/{kind}/{{name}}.png" for kind in ("rgb", "thermal", "labels"))
PARTS = ("train", "test")

# The recording of an image: 58_bag21_rect_rgb_frame0000000440 is from bag 21.
BAG = re.compile(r"(?:^|_)bag(\d+)_")


def bag_of(name: str) -> int | None:
    """Return the number of the recording in `name`; None if there is none."""
    match = BAG.search(name)
    return int(match[1]) if match else None


class PST900(FileDataset):
    """Reads underground RGB-thermal pairs with labels, in the layout of the PST900 archive.

    Layout (NAME as in 58_bag21_rect_rgb_frame0000000440, the same in each folder):
    {train,test}/{rgb,thermal,labels}/NAME.png; thermal_raw and depth are not read.

    The archive has no validation part. As in the CRM and SpatialSeg releases "val" is the test
    part, so that the best checkpoint is chosen on what is reported; `val_bags` takes recordings out
    of training instead. Thermal images are grey levels of 8 bits in which pixels without a
    measurement are 0.

    Class indices are those of the files. Many tables print their columns as hand drill, backpack,
    fire extinguisher, some with the values of drill and extinguisher exchanged; the mean is not
    affected. The authors' colours are in OpenCV's order; here they are (red, green, blue).

    Source: PST900 (Shivakumar et al., ICRA 2020). Nothing is ignored, 255 is accepted.
    """

    images = PairReader(
        layouts=(Patterns.of(*PATTERNS[:2]),),
        advice="use the folder thermal, whose images have 8 bits; thermal_raw is not supported",
    )

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "pst900",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        background: Names = ("background",),
        val_bags: Bags = (),
    ) -> None:
        super().__init__(root, name, num_classes, classes, palette, background=background)
        if not any((self.root / part / "rgb").is_dir() for part in PARTS):
            raise InputError(f"dataset.root: '{root}' does not hold train/rgb or test/rgb.")
        self.codes = indices(num_classes)
        self.val_bags = val_bags
        self.patterns = Patterns.of(*PATTERNS)
        bags = list(val_bags)
        self.splits = {
            "train": "train/rgb/*.png" + f" without the bags {bags}" * bool(bags),
            "val": f"train/rgb/*.png of the bags {bags}" if bags else "test/rgb/*.png",
            "test": "test/rgb/*.png",
        }
        self._part_of: dict[str, list[str]] = {}
        for part in PARTS:
            for values in self.patterns.rgb.files(self.root, {"part": part}).values():
                self._part_of.setdefault(values["name"], []).append(part)

    def listed(self, split: str) -> tuple[str, ...]:
        """Return the names of a split, sorted; InputError if it lacks a bag of `val_bags`."""
        names = {
            part: [n for n in sorted(self._part_of) if part in self._part_of[n]] for part in PARTS
        }
        if split == "test" or (split == "val" and not self.val_bags):
            return tuple(names["test"])
        bags = {bag_of(name) for name in names["train"]}
        for bag in self.val_bags:
            if bag not in bags:
                raise InputError(
                    f"dataset.val_bags: the training part of {self.root} has no bag {bag}; its "
                    f"bags are {sorted(number for number in bags if number is not None)}."
                )
        is_val = split == "val"
        return tuple(name for name in names["train"] if (bag_of(name) in self.val_bags) == is_val)

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`; InputError if no part or both have it."""
        parts = self._part_of.get(name, [])
        if len(parts) != 1:
            reason = "both train and test have" if parts else "neither train nor test has"
            raise InputError(f"{self.name} ({self.root}): {reason} an image called '{name}'.")
        return self.patterns.frame(self.root, name, {"name": name, "part": parts[0]})

    def nights(self, names: tuple[str, ...]) -> None:  # noqa: ARG002 - as every data set
        """Return None: it is dark underground at any time."""

    def repeats(self, split: str) -> bool:
        """Say that the validation split is the test part, unless it has bags of its own."""
        return split == "val" and not self.val_bags

    def unused(self, lists: SplitNames) -> set[Path]:
        """Return files of the layout that belong to no image of a split."""
        return {path for path in super().unused(lists) if path.parts[-3] in PARTS}
