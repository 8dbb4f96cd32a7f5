"""Read MFNet and data sets in its layout: split lists, images, labels, time of day by name."""

from __future__ import annotations

import re
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.file_dataset import Expected, FileDataset, SplitNames
from rgbt.data.folder.frames import FolderFrame, Patterns
from rgbt.data.folder.splits import ByList
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.labels import indices
from rgbt.data.named_files import existing_root
from rgbt.ranges import Colour, Names, NumClasses, Text

Layout = Literal["packed", "folders"]

CLASSES = (
    *("unlabeled", "car", "person", "bike", "curve"),
    *("car_stop", "guardrail", "color_cone", "bump"),
)
PALETTE = (
    *((0, 0, 0), (64, 0, 128), (64, 64, 0), (0, 128, 192), (0, 0, 192)),
    *((128, 128, 0), (64, 64, 128), (192, 128, 128), (192, 64, 0)),
)
LAYOUTS: dict[Layout, PairPattern] = {
    "packed": PairPattern("images/{name}.png", "images/{name}.png", "labels/{name}.png"),
    "folders": PairPattern("RGB/{name}.png", "Thermal/{name}.png", "Label/{name}.png"),
}
FOLDERS = {
    name: tuple(dict.fromkeys(str(text).partition("/")[0] for text in patterns))
    for name, patterns in LAYOUTS.items()
}
EITHER_LAYOUT = " or ".join("+".join(folders) for folders in FOLDERS.values())
SPLITS = {split: f"{split}.txt" for split in ("train", "val", "test", "test_day", "test_night")}

NAME = re.compile(r"\d{5}[DN](_flip)?")
MIRRORED = "_flip"


def time_of(name: str) -> str:
    """The last letter of `name` before the suffix of mirrored copies: D by day, N at night."""
    return name.removesuffix(MIRRORED)[-1:]


class MFNet(FileDataset):
    """RGB-thermal street scenes with labels, in the layout of the MFNet archive.

    Layouts (NAME is a line of a split list, five digits and D for day or N for night):
        packed:  images/NAME.png with channels R, G, B, thermal, and labels/NAME.png
        folders: RGB/NAME.png, Thermal/NAME.png (one channel, or three equal ones), Label/NAME.png

    A name NAME_flip in a list is read from its own files; nothing is mirrored here.

    Source: MFNet (Ha et al., IROS 2017), archive ir_seg_dataset; the folders layout is the one of
    the SpatialSeg and Temporal downloads. Class 0 is a class ("unlabeled", trained and scored as
    in the published tables); 255 is ignored.

    Args:
        root: folder that holds the split lists.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        splits: split -> list file in `root`; two splits may share one list.
        layout: "packed", "folders", or "auto": the one with existing folders (packed first).

    Raises:
        InputError: no such root, no known layout, or numbers of classes, names and colours differ.
    """

    images = PairReader(
        layouts=tuple(PairPattern(*layout[:2]) for layout in LAYOUTS.values()),
        packed_advice="dataset.layout=folders for separate images",
    )
    mirrored = MIRRORED
    expected = Expected(
        "mfnet", day_night={"train": (410, 374), "val": (205, 187), "test": (205, 188)}
    )

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "mfnet",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        background: Names = ("unlabeled",),
        splits: dict[Text, Text] = SPLITS,
        layout: Literal["auto"] | Layout = "auto",
    ) -> None:
        folder = existing_root(root, f"that holds {EITHER_LAYOUT} and the split lists")
        super().__init__(folder, name, num_classes, classes, palette, background=background)
        for known, folders in FOLDERS.items():
            if layout in ("auto", known) and all((folder / each).is_dir() for each in folders):
                self.layout = known
                break
        else:
            wanted = EITHER_LAYOUT if layout == "auto" else "+".join(FOLDERS[layout])
            raise InputError(
                f"dataset.root: '{root}' does not hold the folders {wanted}; give the folder of "
                "the data set itself."
            )
        self.patterns = Patterns.of(*LAYOUTS[self.layout])
        self.codes = indices(num_classes)
        self.rule = ByList(folder, dict(splits), "dataset.splits")

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`."""
        return self.patterns.frame(self.root, name, {"name": name})

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether each name ends in N (night) and not D (day), before the suffix "_flip".

        None if none does, InputError if only some do.
        """
        without = [name for name in names if time_of(name) not in ("D", "N")]
        if len(without) == len(names):
            return None
        if without:
            raise InputError(
                f"the name '{without[0]}' does not state a time of day: expected a name that ends "
                f"in D or N (before '{MIRRORED}'); rename it in the split lists of {self.root}."
            )
        return tuple(time_of(name) == "N" for name in names)

    @property
    def title(self) -> str:
        """One of the two layouts."""
        return f"{self.layout} layout"

    def repeats(self, split: str) -> bool:
        """Lists by time of day only repeat names of others, and need not exist."""
        return super().repeats(split) and not self.has(split)

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Names of another form."""
        return [
            f"split {split}: '{name}' is not five digits followed by D or N (with or without "
            f"'{MIRRORED}')."
            for split, names in lists.items()
            for name in dict.fromkeys(names)
            if not NAME.fullmatch(name)
        ]
