"""PST900: RGB-thermal images of mines and tunnels, with four objects of search and rescue."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Interval
from numpy.typing import NDArray

from rgbt.checks import InputError, nearest
from rgbt.data.file_dataset import FileDataset
from rgbt.data.grey import read_grey
from rgbt.data.images import GreyImages, PairPattern
from rgbt.data.integrity import read_names, within
from rgbt.data.named_files import existing_root, hash_of_files, names_in, root_nearby
from rgbt.data.prepare.pst900 import PREPARATION
from rgbt.data.pst900_layout import FOLDERS, PARTS, SPLITS, bag_of
from rgbt.data.report.pst900 import PST900Checks
from rgbt.ranges import Colour, Names, NumClasses, Text

Bags = tuple[Annotated[int, Interval(ge=0, le=10**6)], ...]
CLASSES = ("background", "fire_extinguisher", "backpack", "hand_drill", "survivor")
PALETTE = ((0, 0, 0), (0, 0, 255), (0, 255, 0), (255, 0, 0), (255, 255, 255))

ADVICE = (
    "the folder thermal holds grey levels, one channel of 8 bits; thermal_raw holds the counts of "
    "the camera and is not read"
)


class PST900(FileDataset):
    """Underground RGB-thermal pairs with labels, in the layout of the PST900 archive.

    Layouts (NAME as in 58_bag21_rect_rgb_frame0000000440, the same in each folder):
        folders: {train,test}/{rgb,thermal,labels}/NAME.png, the archive's own; thermal_raw and
            depth are not read
        lists:   {rgb,thermal,labels}/NAME.png with train.txt, test.txt and, optionally,
            val.txt, as in the LASNet release; used if there is neither train nor test

    Splits: "train", "val", "test". The archive has no validation part. As in the CRM and
    SpatialSeg releases "val" is the test part, so that the best checkpoint is chosen on what is
    reported; `val_bags` takes recordings out of training instead. A list val.txt is "val".

    Class indices are those of the files, in the order of the authors' toolkit. Two traps of
    published material: the authors' colours are in OpenCV's order, so that id 1 is red there; here
    they are (red, green, blue) as the LASNet and CRM releases save them, id 1 being blue. And many
    tables print their columns as hand drill, backpack, fire extinguisher, some with the values of
    drill and extinguisher exchanged: compare by name with care, the mean is not affected.

    Thermal images are grey levels of 8 bits in which pixels without a measurement are 0.

    Source: PST900 (Shivakumar et al., ICRA 2020). Nothing is ignored, 255 is accepted.

    Args:
        root: folder that holds `train` and `test`, or `rgb`, `thermal`, `labels` and the lists.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        val_bags: recordings of the training part that form "val" instead of "train"; (): "val" as
            described above.

    Raises:
        InputError: no such root, neither layout in it, or numbers of classes, names and colours
            differ.
    """

    images = GreyImages(
        layouts=(
            PairPattern("{part}/rgb/{name}.png", "{part}/thermal/{name}.png"),
            PairPattern("rgb/{name}.png", "thermal/{name}.png"),
        ),
        thermal=partial(read_grey, advice=ADVICE),
    )

    preparation = PREPARATION

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "pst900",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        val_bags: Bags = (),
    ) -> None:
        folder = existing_root(root, "that holds train and test of PST900")
        super().__init__(folder, name, num_classes, classes, palette)
        self.val_bags = val_bags
        self.has_lists = _has_lists(self.root)
        self._parts: dict[str, tuple[str, ...]] = {}

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> its files or its list."""
        made_of = {split: self._made_of(self.part_of(split)) for split in SPLITS}
        if self.val_bags:
            bags = list(self.val_bags)
            made_of["train"] += f" without the bags {bags}"
            made_of["val"] += f" of the bags {bags}"
        return made_of

    def part_of(self, split: str) -> str:
        """The part of the archive, or the list, of `split`; InputError if that is unknown."""
        if split not in SPLITS:
            raise InputError(f"dataset: there is no split '{split}'; {nearest(split, SPLITS)}.")
        if split != "val":
            return split
        if self.val_bags:
            return "train"
        return "val" if self.has_lists and (self.root / "val.txt").is_file() else "test"

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        part = self.part_of(split)
        if self.has_lists:
            return self._list(part).is_file()
        return bool(self._part(part, split)) and bool(self._chosen(split))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, sorted, or in the order of its list.

        Raises:
            InputError: unknown split, nothing of it, or a bag of `val_bags` that is not there.
        """
        part = self.part_of(split)
        if self.val_bags and part == "train":
            self._check_bags()
        names = self._chosen(split)
        if not names:
            raise InputError(self._why_empty(split))
        return names

    def thermal(self, name: str) -> NDArray[np.uint8]:
        """The thermal image called `name` alone, (H, W) uint8; InputError as in `read`."""
        return self.images.thermal(within(self.files(name)[1], self.root))

    def files(self, name: str) -> tuple[Path, ...]:
        """RGB, thermal and label of `name`; InputError if no part or both have it."""
        folders = self._folders(name)
        if len(folders) != 1:
            reason = "both train and test have" if folders else "neither train nor test has"
            raise InputError(
                f"{self.name} ({self.root}): {reason} an image called '{name}'; use the original "
                "archive, in which every name is in one part."
            )
        return _files_in(folders[0], name)

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {"num_classes": self.num_classes}

    def nights(self, names: tuple[str, ...]) -> None:  # noqa: ARG002 - as every data set
        """None: it is dark underground at any time."""

    def fingerprint(self) -> str:
        """See `hash_of_files`; a name in both parts has the files of both."""
        splits = {split: self._chosen(split) if self.has(split) else () for split in SPLITS}
        return hash_of_files(
            splits,
            lambda name: [
                path for folder in self._folders(name) for path in _files_in(folder, name)
            ],
        )

    def checks(self) -> PST900Checks:
        """What `rgbt.data.check` checks of this data set."""
        return PST900Checks(self)

    def folders(self) -> tuple[Path, ...]:
        """Every folder that holds rgb, thermal and labels."""
        if self.has_lists:
            return (self.root,)
        return tuple(self.root / part for part in PARTS if (self.root / part).is_dir())

    def _made_of(self, part: str) -> str:
        return f"{part}.txt" if self.has_lists else f"{part}/rgb/*.png"

    def _list(self, part: str) -> Path:
        return self.root / f"{part}.txt"

    def _part(self, part: str, split: str) -> tuple[str, ...]:
        """Names of a part; folders are listed once, so later changes have no effect."""
        if part not in self._parts:
            if self.has_lists:
                lines = read_names(self._list(part), f"split '{split}' of {self.name}")
                self._parts[part] = tuple(line.removesuffix(".png") for line in lines)
            else:
                self._parts[part] = names_in(self.root / part / FOLDERS[0])
        return self._parts[part]

    def _chosen(self, split: str) -> tuple[str, ...]:
        names = self._part(self.part_of(split), split)
        if not self.val_bags or split == "test":
            return names
        return tuple(name for name in names if (bag_of(name) in self.val_bags) == (split == "val"))

    def _folders(self, name: str) -> tuple[Path, ...]:
        """Folders with an image `name`: one, several or none."""
        return (self.root,) if self.has_lists else self._folders_of.get(name, ())

    @cached_property
    def _folders_of(self) -> dict[str, tuple[Path, ...]]:
        folders: dict[str, tuple[Path, ...]] = {}
        for part in PARTS:
            for name in self._part(part, part):
                folders[name] = (*folders.get(name, ()), self.root / part)
        return folders

    def _check_bags(self) -> None:
        known = {str(bag_of(name)) for name in self._part("train", "train")} - {"None"}
        for bag in self.val_bags:
            if str(bag) not in known:
                listed = ", ".join(sorted(known, key=int)) or "none"
                raise InputError(
                    f"dataset.val_bags: the training part of {self.root} has no bag {bag}; its "
                    f"bags are {listed}."
                )

    def _why_empty(self, split: str) -> str:
        part = self.part_of(split)
        advice = f"unpack the folder '{part}' of the archive there"
        if self.val_bags and part == "train":
            advice = "every image is of a bag in dataset.val_bags, remove one of them"
        return (
            f"split '{split}' of {self.name} is empty: expected {self.splits[split]} in "
            f"{self.root}; {advice}."
        )


def _files_in(folder: Path, name: str) -> tuple[Path, ...]:
    return tuple(folder / kind / f"{name}.png" for kind in FOLDERS)


def _has_parts(root: Path) -> bool:
    return any((root / part / FOLDERS[0]).is_dir() for part in PARTS)


def _is_flat(root: Path) -> bool:
    return all((root / kind).is_dir() for kind in FOLDERS)


def _has_lists(root: Path) -> bool:
    """Whether `root` has the layout of lists; InputError if it has neither layout."""
    if _has_parts(root):
        return False
    if _is_flat(root) and any((root / f"{part}.txt").is_file() for part in PARTS):
        return True
    near = root_nearby(root, _has_parts)
    advice = "give the folder into which the archive was unpacked"
    if near is not None:
        advice = f"give {near}, which does"
    elif _is_flat(root):
        advice = (
            "it holds rgb, thermal and labels themselves, but neither train.txt nor test.txt says "
            "which image belongs to which part; write these lists (one name per line)"
        )
    raise InputError(
        f"dataset.root: '{root}' does not hold train/rgb or test/rgb of PST900; {advice}."
    )
