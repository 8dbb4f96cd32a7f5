"""KP: the KAIST multispectral street scenes that carry labels of the 19 classes of Cityscapes.

A reader only: it never resizes, augments or remaps, and it refuses what it cannot read exactly.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, check_choice, nearest
from rgbt.data.dataset import check_lengths
from rgbt.data.files import read_label
from rgbt.data.grey import read_grey
from rgbt.data.images import GreyImages, PairPattern
from rgbt.data.integrity import read_names, within
from rgbt.data.kp_names import FORM, MODALITY, NAME, SPLITS, TIMES, parts_of, set_of
from rgbt.data.kp_names import is_night as is_night
from rgbt.data.kp_names import sets_of as sets_of
from rgbt.data.named_files import (
    hash_of_files,
    names_in,
    root_nearby,
    with_label,
)
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.requirements import Record
from rgbt.types import IGNORE, Sample

Lists = Literal["auto", "files", "sets"]

CLASSES = (
    *("road", "sidewalk", "building", "wall", "fence", "pole", "traffic_light", "traffic_sign"),
    *("vegetation", "terrain", "sky", "person", "rider", "car", "truck", "bus", "train"),
    *("motorcycle", "bicycle"),
)
PALETTE = (
    *((128, 64, 128), (244, 35, 232), (70, 70, 70), (102, 102, 156), (190, 153, 153)),
    *((153, 153, 153), (250, 170, 30), (220, 220, 0), (107, 142, 35), (152, 251, 152)),
    *((70, 130, 180), (220, 20, 60), (255, 0, 0), (0, 0, 142), (0, 0, 70)),
    *((0, 60, 100), (0, 80, 100), (0, 0, 230), (119, 11, 32)),
)
MOST_TINT = 8
"""Grey levels by which the channels of a thermal image may differ at a pixel."""

ADVICE = "use the original file of the folder lwir"

LABELS_OF = {False: "val_day", True: "val_night"}
"""Folders of MS-UDA by whether they hold nights."""


class KP:
    """RGB-thermal street scenes by day and at night with labels, as the CRM release lays them out.

    Layouts (XX is the set, 00 to 11; a name of this data set is setXX_VYYY_IZZZZZ):
        images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg and labels/setXX_VYYY_IZZZZZ.png
        pseudo_KP/{val_day,val_night}/setXX_VYYY_{visible,lwir}_IZZZZZ.png and
            labels/{val_day,val_night}/setXX_VYYY_IZZZZZ.png, as MS-UDA, the labels' origin, has it
    Images and labels are looked for each on their own, the first form before the second.

    Splits: "train", "val", "test" and the day and night of each. Lists hold one name per line, with
    or without .png. Where there is no list SPLIT_day or SPLIT_night, it is that part of SPLIT by
    set number; where there is none of SPLIT, it is SPLIT_day and SPLIT_night together, sorted, as
    the CRM release reads them.

    Label files hold 0 to K - 1 and K (19) for void, which becomes 255; 255 is accepted as well.

    Thermal is the mean over the three channels of the lwir image, rounded. The releases disagree
    where channels differ: CRM takes the mean in real numbers, OpenRSS cuts its fraction off. A grey
    JPEG decodes to equal channels; one that was saved as a colour image may have them apart by a
    few levels, which is why up to `MOST_TINT` are accepted. Beyond that it is a colour picture.

    Source: images KAIST multispectral pedestrian data set (Hwang et al., CVPR 2015); labels MS-UDA
    (Kim et al., RA-L 2021); split CRM (Shin et al., ICRA 2024).

    Args:
        root: folder that holds `images` and `labels`.
        name: what the data set is called in messages and tables.
        num_classes: number of classes; other nodes of the configuration interpolate it.
        classes: their names, in order of the class index.
        palette: their (red, green, blue) colours, 0..255.
        splits: split -> list file in `root`.
        lists: "files" reads the lists of `splits`; "sets" takes every label on disk and divides
            them by set number, as CRM does; "auto" is "files" where there is one of the lists.

    Raises:
        InputError: no such root, no known layout, numbers of classes, names and colours differ, or
            `splits` was changed where sets decide.
    """

    images = GreyImages(
        layouts=(
            PairPattern(
                "images/{set}/{video}/visible/{frame}.jpg", "images/{set}/{video}/lwir/{frame}.jpg"
            ),
            PairPattern(
                "pseudo_KP/{time}/{set}_{video}_visible_{frame}.png",
                "pseudo_KP/{time}/{set}_{video}_lwir_{frame}.png",
            ),
        ),
        thermal=partial(read_grey, advice=ADVICE, most_tint=MOST_TINT),
    )

    unscored: tuple[str, ...] = ()
    """Every class counts in the means, as in the published tables."""

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "kp",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        splits: dict[Text, Text] = SPLITS,
        lists: Lists = "auto",
    ) -> None:
        self.root = Path(root).expanduser()
        self.name = name
        self.num_classes = num_classes
        self.classes = classes
        self.palette = palette
        check_choice("dataset.lists", lists, ("auto", "files", "sets"))
        check_lengths(num_classes, classes, palette)
        _check_root(self.root, root)
        self.lists: Literal["files", "sets"] = _find_lists(self.root, splits, lists)
        self._files = dict(splits)
        self._names: dict[str, tuple[str, ...]] = {}

    @property
    def record(self) -> Record:
        """The number of its classes."""
        return Record(num_classes=self.num_classes)

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> its list, or the sets that it is made of."""
        if self.lists == "files":
            return self._files
        return {
            split: "labels of " + ", ".join(f"set{number:02d}" for number in sets_of(split))
            for split in SPLITS
        }

    def has(self, split: str) -> bool:
        """Whether anything of `split` is there; InputError where the split is unknown."""
        self._check_split(split)
        if self.lists != "files":
            return bool(self._with_labels(split))
        sources = self._sources(split)
        if len(sources) != 1 or sources == (split,):
            return bool(sources)
        # A part of a list that holds days or nights alone may be empty.
        return any(self._is_of_time(name, split) for name in self._read_list(sources[0]))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in the order of its list, or sorted.

        Raises:
            InputError: unknown split, missing or empty list, a line that is no name, no label of
                the sets.
        """
        self._check_split(split)
        if split not in self._names:
            read = self._of_lists if self.lists == "files" else self._of_sets
            self._names[split] = read(split)
        return self._names[split]

    def read(self, name: str) -> Sample:
        """The triple called `name`, decoded.

        Returns:
            Sample with rgb (H, W, 3), thermal (H, W), label (H, W), all uint8.

        Raises:
            InputError: not a name, a file is missing, cannot be decoded, has other channels, bits
                or size than expected, or the label holds a value that is no class, void or 255.
        """
        pair = self.pair(name)
        return with_label(pair, self.label(name), self.label_path(name))

    def pair(self, name: str) -> Sample:
        """The images of `read` alone, without the label; InputError as there."""
        rgb, thermal = (within(path, self.root) for path in self.files(name)[:2])
        return self.images.read(name, rgb, thermal)

    def label(self, name: str) -> NDArray[np.uint8]:
        """The label called `name` alone, (H, W) uint8; InputError as in `read`."""
        # One value more than there are classes: void.
        label = read_label(within(self.files(name)[-1], self.root), self.num_classes + 1)
        label[label == self.num_classes] = IGNORE
        return label

    def files(self, name: str) -> tuple[Path, ...]:
        """RGB, thermal and label of `name`; InputError where it is not a name."""
        recording, video, frame = parts_of(name)
        if self.has_images:
            folder = self.root / "images" / recording / video
            images = tuple(folder / kind / f"{frame}.jpg" for kind in ("visible", "lwir"))
        else:
            folder = self.root / "pseudo_KP" / LABELS_OF[is_night(name)]
            images = tuple(
                folder / f"{recording}_{video}_{kind}_{frame}.png" for kind in ("visible", "lwir")
            )
        return (*images, self.label_path(name))

    def label_path(self, name: str) -> Path:
        """The label of `name`; InputError where it is not a name."""
        folder = self.root / "labels"
        return (folder if self.has_labels else folder / LABELS_OF[is_night(name)]) / f"{name}.png"

    def list_files(self, split: str) -> tuple[str, ...]:
        """The lists that `split` is read from; () where sets divide, or no list is there."""
        found = self._sources(split) if self.lists == "files" else ()
        return tuple(self._files[source] for source in found)

    def decoding(self) -> dict[str, Any]:
        """What decides, beside the files, what `read` makes of them."""
        return {"num_classes": self.num_classes, "most_tint": MOST_TINT}

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each image was taken at night, by set number; InputError for other names."""
        return tuple(is_night(name) for name in names)

    def fingerprint(self) -> str:
        """SHA-256 in hexadecimal over the names of every split and the sizes of their files."""
        splits = {split: self.names(split) if self.has(split) else () for split in self.splits}
        return hash_of_files(splits, self.files)

    @cached_property
    def has_images(self) -> bool:
        """Whether images lie in folders by set and video, and not as MS-UDA has them."""
        return (self.root / "images").is_dir()

    @cached_property
    def has_labels(self) -> bool:
        """Whether labels lie in one folder, and not as MS-UDA has them."""
        folder = self.root / "labels"
        by_time = any((folder / each).is_dir() for each in LABELS_OF.values())
        return not by_time or any(folder.glob("set*.png"))

    @cached_property
    def labels_on_disk(self) -> tuple[str, ...]:
        """Sorted names of the label files, whatever they are called, listed once."""
        folder = self.root / "labels"
        folders = [folder] if self.has_labels else [folder / each for each in LABELS_OF.values()]
        return tuple(sorted({name for each in folders for name in names_in(each)}))

    def _check_split(self, split: str) -> None:
        if split not in self.splits:
            raise InputError(
                f"dataset.splits has no split '{split}'; {nearest(split, self.splits)}."
            )

    def _sources(self, split: str) -> tuple[str, ...]:
        """Splits whose lists `split` is read from: its own, the one it is a part of, its parts."""

        def is_there(each: str) -> bool:
            return each in self._files and (self.root / self._files[each]).is_file()

        base, _, time = split.rpartition("_")
        parts = tuple(f"{split}_{time}" for time in TIMES)
        if is_there(split):
            return (split,)
        if time in TIMES and is_there(base):
            return (base,)
        return parts if all(map(is_there, parts)) else ()

    @staticmethod
    def _is_of_time(name: str, split: str) -> bool:
        return is_night(name) == split.endswith("_night")

    def _of_lists(self, split: str) -> tuple[str, ...]:
        sources = self._sources(split) or (split,)
        names = [name for source in sources for name in self._read_list(source)]
        if len(sources) > 1:
            return tuple(sorted(names))
        if sources != (split,):
            names = [name for name in names if self._is_of_time(name, split)]
        if not names:
            raise InputError(
                f"split '{split}' of {self.name} is empty: there is no such image in "
                f"'{self.root / self._files[sources[0]]}'."
            )
        return tuple(names)

    def _read_list(self, split: str) -> tuple[str, ...]:
        path = self.root / self._files[split]
        if not path.is_file():
            raise InputError(
                f"dataset.splits.{split}: there is no list '{path}'; write it (one name per line), "
                "or divide the labels on disk by their sets with dataset.lists=sets."
            )
        lines = read_names(path, f"dataset.splits.{split}")
        names = tuple(MODALITY.sub("_", line.removesuffix(".png")) for line in lines)
        for name in names:
            if NAME.fullmatch(name) is None:
                raise InputError(
                    f"dataset.splits.{split}: '{name}' in '{path}' is not {FORM}; correct the line."
                )
        return names

    def _with_labels(self, split: str) -> tuple[str, ...]:
        wanted = sets_of(split)
        return tuple(
            name for name in self.labels_on_disk if NAME.fullmatch(name) and set_of(name) in wanted
        )

    def _of_sets(self, split: str) -> tuple[str, ...]:
        names = self._with_labels(split)
        if not names:
            raise InputError(
                f"split '{split}' of {self.name} is empty: expected {self.splits[split]} in "
                f"{self.root / 'labels'}; unpack all labels of KP there."
            )
        return names


def _holds_kp(root: Path) -> bool:
    return (root / "labels").is_dir() and any(
        (root / images).is_dir() for images in ("images", "pseudo_KP")
    )


def _check_root(root: Path, given: str) -> None:
    if not root.is_dir():
        raise InputError(
            f"dataset.root: there is no folder '{given}'; give the one that holds images and "
            "labels of KP."
        )
    if not _holds_kp(root):
        near = root_nearby(root, _holds_kp) or "the folder that does"
        raise InputError(
            f"dataset.root: '{root}' does not hold the folders images and labels of KP (or "
            f"pseudo_KP and labels); give {near}."
        )


def _find_lists(root: Path, splits: dict[str, str], wanted: Lists) -> Literal["files", "sets"]:
    """Who says what a split is made of; a changed `splits` asks for files."""
    changed = dict(splits) != SPLITS
    if wanted == "sets":
        if changed:
            raise InputError(
                "dataset.splits names lists but dataset.lists=sets reads none; leave one of them "
                "as it is."
            )
        return "sets"
    there = any((root / path).is_file() for path in splits.values())
    return "files" if wanted == "files" or there or changed else "sets"
