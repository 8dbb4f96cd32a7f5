"""Read PST900: RGB-thermal images of mines and tunnels, with four objects of search and rescue."""

from __future__ import annotations

from collections import Counter
from functools import cached_property
from pathlib import Path
from typing import Annotated

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.data.file_dataset import Expected, FileDataset, SplitNames
from rgbt.data.folder.frames import FolderFrame, Patterns
from rgbt.data.folder.splits import ByList
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.labels import indices
from rgbt.data.named_files import existing_root, names_in, root_nearby
from rgbt.data.pst900_layout import FOLDERS, PARTS, SPLITS, bag_of
from rgbt.ranges import Colour, Names, NumClasses, Text

Bags = tuple[Annotated[int, Interval(ge=0, le=10**6)], ...]
CLASSES = ("background", "fire_extinguisher", "backpack", "hand_drill", "survivor")
PALETTE = ((0, 0, 0), (0, 0, 255), (0, 255, 0), (255, 0, 0), (255, 255, 255))

TEST_BAGS = {21: 40, 22: 59, 23: 28, 24: 72, 25: 89}
"""Recording -> pairs of the test part, 288 in all."""


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
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        val_bags: recordings of the training part that form "val" instead of "train"; (): "val" as
            described above.

    Raises:
        InputError: no such root, neither layout in it, or numbers of classes, names and colours
            differ.
    """

    images = PairReader(
        layouts=(
            PairPattern("{part}/rgb/{name}.png", "{part}/thermal/{name}.png"),
            PairPattern("rgb/{name}.png", "thermal/{name}.png"),
        ),
        advice="use the folder thermal, which holds grey levels in one channel of 8 bits; "
        "thermal_raw holds the counts of the camera and is not supported",
    )
    clipping = (0, 255)
    # The archive holds 597 training pairs; the data set's page says 606.
    expected = Expected("pst900", images={"train": 597, "test": 288}, hw=(720, 1280))

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
        folder = existing_root(root, "that holds train and test of PST900")
        super().__init__(folder, name, num_classes, classes, palette, background=background)
        self.codes = indices(num_classes)
        self.val_bags = val_bags
        if val_bags:
            self.expected = self.expected._replace(images={"test": self.expected.images["test"]})
        self.has_lists = _has_lists(folder)
        prefix = "" if self.has_lists else "{part}/"
        self.patterns = Patterns.of(*(f"{prefix}{kind}/{{name}}.png" for kind in FOLDERS))
        self._lists = ByList(folder, {part: f"{part}.txt" for part in SPLITS}, "split")

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its files or its list."""
        made_of = {}
        for split in SPLITS:
            part = self.part_of(split)
            made_of[split] = f"{part}.txt" if self.has_lists else f"{part}/rgb/*.png"
        if self.val_bags:
            bags = list(self.val_bags)
            made_of["train"] += f" without the bags {bags}"
            made_of["val"] += f" of the bags {bags}"
        return made_of

    def part_of(self, split: str) -> str:
        """The part of the archive, or the list, of a known `split`."""
        if split != "val":
            return split
        if self.val_bags:
            return "train"
        return "val" if self.has_lists and self._lists.has("val") else "test"

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        if self.has_lists:
            return self._lists.has(self.part_of(split))
        return bool(self._chosen(split))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, sorted, or in the order of its list.

        Raises:
            InputError: unknown split, nothing of it, or a bag of `val_bags` that is not there.
        """
        self.check_split(split)
        part = self.part_of(split)
        advice = f"unpack the folder '{part}' of the archive there"
        if self.val_bags and part == "train":
            advice = "every image is of a bag in dataset.val_bags; remove one of them"
            known = {bag for name in self._part("train") if (bag := bag_of(name)) is not None}
            for bag in self.val_bags:
                if bag not in known:
                    raise InputError(
                        f"dataset.val_bags: the training part of {self.root} has no bag {bag}; "
                        f"its bags are {', '.join(map(str, sorted(known))) or 'none'}."
                    )
        names = self._chosen(split)
        if not names:
            raise InputError(
                f"split '{split}' of {self.name} is empty: expected {self.splits[split]} in "
                f"{self.root}; {advice}."
            )
        return names

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; InputError if no part or both have it."""
        if self.has_lists:
            return self.patterns.frame(self.root, name, {"name": name})
        parts = [part for part in PARTS if name in self._names_of[part]]
        if len(parts) != 1:
            reason = "both train and test have" if parts else "neither train nor test has"
            raise InputError(
                f"{self.name} ({self.root}): {reason} an image called '{name}'; use the original "
                "archive, in which every name is in one part."
            )
        return self.patterns.frame(self.root, name, {"name": name, "part": parts[0]})

    def files(self, name: str) -> tuple[Path, ...]:
        """RGB, thermal and label of `name`; of both parts if both have it."""
        if self.has_lists:
            return super().files(name)
        return tuple(
            self.root / part / kind / f"{name}.png"
            for part in PARTS
            for kind in FOLDERS
            if name in self._names_of[part]
        )

    def nights(self, names: tuple[str, ...]) -> None:  # noqa: ARG002 - as every data set
        """None: it is dark underground at any time."""

    @property
    def title(self) -> str:
        """One of the two layouts."""
        return f"PST900 in {'lists' if self.has_lists else 'folders'}"

    def repeats(self, split: str) -> bool:
        """The validation split is the test part, unless it has a list or bags of its own."""
        return split == "val" and self.part_of(split) == "test"

    def unused(self, lists: SplitNames) -> set[Path]:
        """Files of the layout that belong to no image of a split."""
        found = super().unused(lists)
        return {path for path in found if self.has_lists or path.parts[-3] in PARTS}

    def own_notes(self, lists: SplitNames) -> list[str]:
        """What "val" is, and recordings in the wrong part."""
        notes = []
        if self.repeats("val"):
            notes.append(
                "split val is the test part, as in the CRM release, so the best checkpoint is "
                "selected on the test images. dataset.val_bags validates on recordings of the "
                "training part instead."
            )
        if self.name != "pst900":
            return notes
        bags = {split: Counter(map(bag_of, lists.get(split, ()))) for split in PARTS}
        tested = sum(bags["train"][bag] for bag in TEST_BAGS)
        if tested:
            part = "is" if tested == bags["train"].total() else "holds"
            notes.append(
                f"split train {part} {tested} images of the bags 21 to 25, which belong to the "
                "test part of the archive. The folders train and test seem to be swapped, as in "
                "the drawing on the data set's page; swap them back."
            )
        if bags["test"] and bags["test"] != Counter(TEST_BAGS):
            found, listed = (
                ", ".join(
                    f"{count} of {'no bag' if bag is None else f'bag {bag}'}"
                    for bag, count in sorted(each.items(), key=lambda item: item[0] or -1)
                )
                for each in (bags["test"], TEST_BAGS)
            )
            notes.append(f"split test has {found}; the archive has {listed}.")
        return notes

    @cached_property
    def _names_of(self) -> dict[str, dict[str, None]]:
        """Part -> its names, sorted; folders are listed once, so later changes have no effect."""
        return {part: dict.fromkeys(names_in(self.root / part / FOLDERS[0])) for part in PARTS}

    def _part(self, part: str) -> tuple[str, ...]:
        if not self.has_lists:
            return tuple(self._names_of[part])
        return tuple(line.removesuffix(".png") for line in self._lists.names(part))

    def _chosen(self, split: str) -> tuple[str, ...]:
        names = self._part(self.part_of(split))
        if not self.val_bags or split == "test":
            return names
        return tuple(name for name in names if (bag_of(name) in self.val_bags) == (split == "val"))


def _has_lists(root: Path) -> bool:
    """Whether `root` has the layout of lists; InputError if it has neither layout."""

    def has_parts(folder: Path) -> bool:
        return any((folder / part / FOLDERS[0]).is_dir() for part in PARTS)

    is_flat = all((root / kind).is_dir() for kind in FOLDERS)
    if has_parts(root):
        return False
    if is_flat and any((root / f"{part}.txt").is_file() for part in PARTS):
        return True
    near = root_nearby(root, has_parts)
    advice = "give the folder into which the archive was unpacked"
    if near is not None:
        advice = f"give {near}, which does"
    elif is_flat:
        advice = (
            "it holds rgb, thermal and labels, but neither train.txt nor test.txt. Write these "
            "lists of the parts (one name per line)"
        )
    raise InputError(
        f"dataset.root: '{root}' does not hold train/rgb or test/rgb of PST900; {advice}."
    )
