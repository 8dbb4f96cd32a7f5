"""KP: the KAIST multispectral street scenes that carry labels of the 19 classes of Cityscapes."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset
from rgbt.data.files import read_label
from rgbt.data.grey import read_grey
from rgbt.data.images import GreyImages, PairPattern
from rgbt.data.integrity import read_names, within
from rgbt.data.kp_layout import (
    FORM,
    LABELS_OF,
    MODALITY,
    NAME,
    SPLITS,
    TIMES,
    is_night,
    parts_of,
    set_of,
    sets_of,
)
from rgbt.data.named_files import check_split, existing_root, hash_of_files, names_in, root_nearby
from rgbt.data.prepare.kp import PREPARATION
from rgbt.data.report.kp import KPChecks
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

ListSource = Literal["auto", "files", "sets"]

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


class KP(FileDataset):
    """RGB-thermal street scenes by day and at night with labels, as the CRM release lays them out.

    Layouts (XX is the set, 00 to 11; a name of this data set is setXX_VYYY_IZZZZZ):
        images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg and labels/setXX_VYYY_IZZZZZ.png
        pseudo_KP/{val_day,val_night}/setXX_VYYY_{visible,lwir}_IZZZZZ.png and
            labels/{val_day,val_night}/setXX_VYYY_IZZZZZ.png, as MS-UDA, the labels' origin, has it
    The layouts of images and of labels are detected separately, the first one first.

    Splits: "train", "val", "test" and the day and night of each. Lists hold one name per line, with
    or without .png. Without a list SPLIT_day or SPLIT_night, that split is the part of SPLIT by set
    number; without a list SPLIT, it is SPLIT_day and SPLIT_night together, sorted, as in the CRM
    release.

    Label files hold 0 to K - 1 and K (19) for void, which becomes 255; 255 is accepted as well.

    Thermal is the mean over the three channels of the lwir image, rounded. If channels differ, the
    releases disagree: CRM takes the real mean, OpenRSS truncates it. A grey JPEG decodes to equal
    channels; if it was saved as a colour image, its channels may differ by a few levels. A
    difference of up to `MOST_TINT` is accepted; an image with a larger one is a colour image.

    Source: images KAIST multispectral pedestrian data set (Hwang et al., CVPR 2015); labels MS-UDA
    (Kim et al., RA-L 2021); split CRM (Shin et al., ICRA 2024).

    Args:
        root: folder that holds `images` and `labels`.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        splits: split -> list file in `root`.
        lists: "files" reads the lists of `splits`; "sets" divides all labels on disk by set number,
            as CRM does; "auto" is "files" if one of the lists exists.

    Raises:
        InputError: no such root, no known layout, numbers of classes, names and colours differ, or
            `splits` is set although sets are used.
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

    preparation = PREPARATION

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "kp",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        splits: dict[Text, Text] = SPLITS,
        lists: ListSource = "auto",
    ) -> None:
        folder = existing_root(root, "that holds images and labels of KP")
        super().__init__(folder, name, num_classes, classes, palette)
        _check_root(self.root)
        self.lists: Literal["files", "sets"] = _find_lists(self.root, splits, lists)
        self._files = dict(splits)
        self._names: dict[str, tuple[str, ...]] = {}

    @property
    def splits(self) -> Mapping[str, str]:
        """Split -> its list, or its sets."""
        if self.lists == "files":
            return self._files
        return {
            split: "labels of " + ", ".join(f"set{number:02d}" for number in sets_of(split))
            for split in SPLITS
        }

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        check_split(split, self.splits)
        if self.lists != "files":
            return bool(self._with_labels(split))
        sources = self._sources(split)
        if len(sources) != 1 or sources == (split,):
            return bool(sources)
        # The list may contain days or nights only.
        return any(self._is_of_time(name, split) for name in self._read_list(sources[0]))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in the order of its list, or sorted.

        Raises:
            InputError: unknown split, missing or empty list, an invalid name, no label of the sets.
        """
        check_split(split, self.splits)
        if split not in self._names:
            read = self._of_lists if self.lists == "files" else self._of_sets
            self._names[split] = read(split)
        return self._names[split]

    def label(self, name: str) -> NDArray[np.uint8]:
        """The label of `read` alone, (H, W) uint8; InputError as there."""
        # The value after the last class is void.
        label = read_label(within(self.files(name)[-1], self.root), self.num_classes + 1)
        label[label == self.num_classes] = IGNORE
        return label

    def files(self, name: str) -> tuple[Path, ...]:
        """RGB, thermal and label of `name`; InputError if the name is invalid."""
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
        """The label of `name`; InputError if the name is invalid."""
        folder = self.root / "labels"
        return (folder if self.has_labels else folder / LABELS_OF[is_night(name)]) / f"{name}.png"

    def list_files(self, split: str) -> tuple[str, ...]:
        """The lists that `split` is read from; () if sets are used, or no list exists."""
        sources = self._sources(split) if self.lists == "files" else ()
        return tuple(self._files[source] for source in sources)

    def decoding(self) -> dict[str, Any]:
        """Settings that change what `read` makes of the files."""
        return {"num_classes": self.num_classes, "most_tint": MOST_TINT}

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each image was taken at night, by set number; InputError for other names."""
        return tuple(is_night(name) for name in names)

    def fingerprint(self) -> str:
        """See `hash_of_files`."""
        splits = {split: self.names(split) if self.has(split) else () for split in self.splits}
        return hash_of_files(splits, self.files)

    def checks(self) -> KPChecks:
        """What `rgbt.data.check` checks of this data set."""
        return KPChecks(self)

    @cached_property
    def has_images(self) -> bool:
        """Whether images are in folders by set and video, and not in the layout of MS-UDA."""
        return (self.root / "images").is_dir()

    @cached_property
    def has_labels(self) -> bool:
        """Whether labels are in one folder, and not in the layout of MS-UDA."""
        folder = self.root / "labels"
        by_time = any((folder / each).is_dir() for each in LABELS_OF.values())
        return not by_time or any(folder.glob("set*.png"))

    @cached_property
    def labels_on_disk(self) -> tuple[str, ...]:
        """Sorted names of all label files, valid or not; listed once."""
        folder = self.root / "labels"
        folders = [folder] if self.has_labels else [folder / each for each in LABELS_OF.values()]
        return tuple(sorted({name for each in folders for name in names_in(each)}))

    def _sources(self, split: str) -> tuple[str, ...]:
        """Splits with the lists that `split` is read from: itself, the whole, or its parts."""

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


def _check_root(root: Path) -> None:
    if not _holds_kp(root):
        near = root_nearby(root, _holds_kp) or "the folder that does"
        raise InputError(
            f"dataset.root: '{root}' does not hold the folders images and labels of KP (or "
            f"pseudo_KP and labels); give {near}."
        )


def _find_lists(root: Path, splits: dict[str, str], wanted: ListSource) -> Literal["files", "sets"]:
    """The source of the splits; with a changed `splits` it is files."""
    changed = dict(splits) != SPLITS
    if wanted == "sets":
        if changed:
            raise InputError(
                "dataset.splits names lists but dataset.lists=sets reads none; omit one of them."
            )
        return "sets"
    exist = any((root / path).is_file() for path in splits.values())
    return "files" if wanted == "files" or exist or changed else "sets"
