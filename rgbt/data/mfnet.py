"""MFNet and data sets in its layout: split lists, images, labels, time of day by name."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset
from rgbt.data.files import read_thermal
from rgbt.data.images import GreyImages, PairPattern
from rgbt.data.integrity import read_names
from rgbt.data.mfnet_layout import FOLDERS, MIRRORED, SPLITS, base_name, either_layout
from rgbt.data.named_files import check_split, existing_root, hash_of_files
from rgbt.data.prepare.mfnet import PREPARATION
from rgbt.data.report.mfnet import MFNetChecks
from rgbt.ranges import Colour, Names, NumClasses, Text

LayoutName = Literal["auto", "packed", "folders"]

CLASSES = (
    *("unlabeled", "car", "person", "bike", "curve"),
    *("car_stop", "guardrail", "color_cone", "bump"),
)
PALETTE = (
    *((0, 0, 0), (64, 0, 128), (64, 64, 0), (0, 128, 192), (0, 0, 192)),
    *((128, 128, 0), (64, 64, 128), (192, 128, 128), (192, 64, 0)),
)


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
        splits: split -> list file in `root`; two splits may share one list.
        layout: "packed", "folders", or "auto": the one with existing folders (packed first).

    Raises:
        InputError: no such root, no known layout, or numbers of classes, names and colours differ.
    """

    images = GreyImages(
        layouts=tuple(
            PairPattern(f"{folders[0]}/{{name}}.png", f"{folders[-2]}/{{name}}.png")
            for folders in FOLDERS.values()
        ),
        thermal=read_thermal,
        packed_advice="dataset.layout=folders for separate images",
    )

    preparation = PREPARATION

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "mfnet",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        splits: dict[Text, Text] = SPLITS,
        layout: LayoutName = "auto",
    ) -> None:
        folder = existing_root(root, f"that holds {either_layout()} and the split lists")
        super().__init__(folder, name, num_classes, classes, palette)
        self.splits = dict(splits)
        self.layout = _find_layout(self.root, layout)
        self._names: dict[str, tuple[str, ...]] = {}

    def has(self, split: str) -> bool:
        """Whether the list of `split` exists; InputError if the split is unknown."""
        return self.list_path(split).is_file()

    def names(self, split: str) -> tuple[str, ...]:
        """Names in the order of the list; InputError if it is unknown, missing or empty."""
        if split not in self._names:
            self._names[split] = self._read_list(split)
        return self._names[split]

    def files(self, name: str) -> tuple[Path, ...]:
        """The packed image of `name`, or its RGB and its thermal image, and its label."""
        return tuple(self.root / folder / f"{name}.png" for folder in FOLDERS[self.layout])

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {"layout": self.layout, "num_classes": self.num_classes}

    def is_night(self, name: str) -> bool:
        """Whether the last letter of the name, before the suffix, is N (night) and not D (day).

        Raises:
            InputError: the name ends in neither letter.
        """
        letter = base_name(name)[-1:]
        if letter not in ("D", "N"):
            raise InputError(
                f"the name '{name}' has no time of day: expected a name that ends in D or N "
                f"(before '{MIRRORED}'); rename it in the split lists of {self.root}."
            )
        return letter == "N"

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """`is_night` of every name; None if none states the time of day, InputError if some do."""
        if not any(base_name(name)[-1:] in ("D", "N") for name in names):
            return None
        return tuple(self.is_night(name) for name in names)

    def fingerprint(self) -> str:
        """See `hash_of_files`; splits without a list are empty."""
        listed = {split: self.names(split) if self.has(split) else () for split in self.splits}
        return hash_of_files(listed, self.files)

    def checks(self) -> MFNetChecks:
        """What `rgbt.data.check` checks of this data set."""
        return MFNetChecks(self)

    def list_path(self, split: str) -> Path:
        """The list file of `split`; InputError if the split is unknown."""
        check_split(split, self.splits)
        return self.root / self.splits[split]

    def names_on_disk(self) -> frozenset[str]:
        """Names of all PNG files in the folders of images and labels, listed or not."""
        folders = [self.root / folder for folder in FOLDERS[self.layout]]
        return frozenset(path.stem for folder in folders for path in folder.glob("*.png"))

    def _read_list(self, split: str) -> tuple[str, ...]:
        path = self.list_path(split)
        if not path.is_file():
            raise InputError(
                f"dataset.splits.{split}: there is no list '{path}'; write it (one name per line), "
                f"or name another list with dataset.splits.{split}=..."
            )
        return read_names(path, f"dataset.splits.{split}")


def _find_layout(root: Path, wanted: LayoutName) -> Literal["packed", "folders"]:
    for layout in ("packed", "folders"):
        folders_exist = all((root / folder).is_dir() for folder in FOLDERS[layout])
        if wanted in ("auto", layout) and folders_exist:
            return layout
    expected = either_layout() if wanted == "auto" else "+".join(FOLDERS[wanted])
    raise InputError(
        f"dataset.root: '{root}' does not hold the folders {expected}; give the folder of the "
        "data set itself."
    )
