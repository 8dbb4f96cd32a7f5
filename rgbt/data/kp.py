"""Read KP: the KAIST multispectral street scenes with labels of the 19 classes of Cityscapes."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.file_dataset import Expected, FileDataset, SplitNames
from rgbt.data.folder.frames import FolderFrame, Patterns
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.integrity import read_names
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
from rgbt.data.labels import indices
from rgbt.data.named_files import existing_root, names_in, root_nearby
from rgbt.ranges import Colour, Names, NumClasses, Text

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
IMAGES = {
    "the CRM release": PairPattern(
        "images/{set}/{video}/visible/{frame}.jpg", "images/{set}/{video}/lwir/{frame}.jpg"
    ),
    "MS-UDA": PairPattern(
        "pseudo_KP/{time}/{set}_{video}_visible_{frame}.png",
        "pseudo_KP/{time}/{set}_{video}_lwir_{frame}.png",
    ),
}
LABELS = {
    "the CRM release": "labels/{set}_{video}_{frame}.png",
    "MS-UDA": "labels/{time}/{set}_{video}_{frame}.png",
}


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
    difference of up to 8 levels is accepted; an image with a larger one is a colour image.

    Source: images KAIST multispectral pedestrian data set (Hwang et al., CVPR 2015); labels MS-UDA
    (Kim et al., RA-L 2021); split CRM (Shin et al., ICRA 2024).

    Args:
        root: folder that holds `images` and `labels`.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        splits: split -> list file in `root`.
        lists: "files" reads the lists of `splits`; "sets" divides all labels on disk by set number,
            as CRM does; "auto" is "files" if one of the lists exists.

    Raises:
        InputError: no such root, no known layout, numbers of classes, names and colours differ, or
            `splits` is set although sets are used.
    """

    images = PairReader(
        layouts=tuple(IMAGES.values()),
        most_tint=8,
        advice="use the original file of the folder lwir",
    )
    expected = Expected(
        "kp",
        day_night={"train": (261, 238), "val": (64, 76), "test": (178, 133)},
        hw=(512, 640),
    )

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "kp",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        background: Names = (),
        splits: dict[Text, Text] = SPLITS,
        lists: ListSource = "auto",
    ) -> None:
        folder = existing_root(root, "that holds images and labels of KP")
        super().__init__(folder, name, num_classes, classes, palette, background=background)
        self.codes = indices(num_classes, num_classes)  # the value after the last class is void
        if not _holds_kp(folder):
            near = root_nearby(folder, _holds_kp) or "the folder that does"
            raise InputError(
                f"dataset.root: '{folder}' does not hold the folders images and labels of KP (or "
                f"pseudo_KP and labels); give {near}."
            )
        self.lists: Literal["files", "sets"] = _find_lists(folder, splits, lists)
        by_time = any((folder / "labels" / each).is_dir() for each in LABELS_OF.values())
        has_labels = not by_time or any((folder / "labels").glob("set*.png"))
        self.layout = "the CRM release" if (folder / "images").is_dir() else "MS-UDA"
        labels = LABELS["the CRM release" if has_labels else "MS-UDA"]
        self.patterns = Patterns.of(*IMAGES[self.layout][:2], labels)
        self._files = dict(splits)

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its list, or its sets."""
        if self.lists == "files":
            return self._files
        return {
            split: "labels of " + ", ".join(f"set{number:02d}" for number in sets_of(split))
            for split in SPLITS
        }

    def has(self, split: str) -> bool:
        """Whether any sample of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        if self.lists != "files":
            return bool(self._of_sets(split))
        sources = self._sources(split)
        if len(sources) != 1 or sources == (split,):
            return bool(sources)
        # The list may contain days or nights only.
        return bool(self._of_time(self._read_list(sources[0]), split))

    def names(self, split: str) -> tuple[str, ...]:
        """Names of a split, in the order of its list, or sorted.

        Raises:
            InputError: unknown split, missing or empty list, an invalid name, no label of the sets.
        """
        self.check_split(split)
        if split not in self._names:
            names = self._of_lists(split) if self.lists == "files" else self._of_sets(split)
            if not names:
                expected = (
                    f"{self.splits[split]} in {self.root / 'labels'}; unpack all labels of KP"
                )
                if self.lists == "files":
                    listed = ", ".join(self.list_files(split))
                    expected = f"such an image in '{self.root / listed}'; correct the list"
                raise InputError(
                    f"split '{split}' of {self.name} is empty: expected {expected} there."
                )
            self._names[split] = names
        return self._names[split]

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; InputError if the name is invalid."""
        values = dict(zip(("set", "video", "frame"), parts_of(name), strict=True))
        values["time"] = LABELS_OF[is_night(name)]
        return self.patterns.frame(self.root, name, values)

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Whether each image was taken at night, by set number; InputError for other names."""
        return tuple(is_night(name) for name in names)

    def list_files(self, split: str) -> tuple[str, ...]:
        """The lists that `split` is read from; () if sets are used, or no list exists."""
        sources = self._sources(split) if self.lists == "files" else ()
        return tuple(self._files[source] for source in sources)

    @property
    def title(self) -> str:
        """The layout of images and labels, and the source of the splits."""
        origin = "list files" if self.lists == "files" else "set numbers"
        return f"KP in the layout of {self.layout}, splits from {origin}"

    def sources(self, split: str) -> tuple[str, ...]:
        """The lists of a split, or its sets: without a test list two splits may share one."""
        return self.list_files(split) if self.lists == "files" else super().sources(split)

    def unused(self, lists: SplitNames) -> list[Path]:
        """Labels of no split; images without a label are many and not meant."""
        listed = set().union(*lists.values())
        assert self.patterns.label is not None, "every layout has labels"
        paths = (match.path for match in self.patterns.label.files(self.root))
        return [path for path in paths if path.stem not in listed and NAME.fullmatch(path.stem)]

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Labels of other names, and splits that are not the union of their day and their night."""
        strange = [name for name in self.labels_on_disk if NAME.fullmatch(name) is None]
        problems = [
            f"{len(strange)} labels have names without a set; the first is '{name}.png'."
            for name in strange[:1]
        ]
        for split, names in lists.items():
            parts = [f"{split}_{time}" for time in TIMES]
            if not all(part in lists for part in parts):
                continue
            differ = sorted(set(names) ^ {name for part in parts for name in lists[part]})
            if differ:
                problems.append(
                    f"split {split} is not the union of {parts[0]} and {parts[1]}: {len(differ)} "
                    f"names are missing on one side; the first is '{differ[0]}'."
                )
        return problems

    def own_notes(self, lists: SplitNames) -> list[str]:
        """The source of the splits, and whether it is the division of MS-UDA."""
        if self.lists == "sets":
            notes = [
                "no list is used: all labels on disk are divided into splits by set numbers, as "
                "in the CRM release."
            ]
        else:
            files = dict.fromkeys(path for split in self.splits for path in self.list_files(split))
            notes = [f"splits are read from the lists {', '.join(files) or '(none)'}."]
        train, val = lists.get("train", ()), lists.get("val", ())
        # Days that CRM tests or validates on.
        is_ms_uda = not any(self.nights(train)) and all(self.nights(val)) and val
        if self.name == "kp" and is_ms_uda and not {6, 7, 8}.isdisjoint(map(set_of, train)):
            notes.append(
                "the training split has only days and the validation split only nights, as in "
                "MS-UDA. Scores are not comparable with those of CRM, which trains on both; "
                "dataset.lists=sets uses the splits of CRM."
            )
        return notes

    @cached_property
    def labels_on_disk(self) -> tuple[str, ...]:
        """Sorted names of all label files, valid or not; listed once."""
        folder = self.root / "labels"
        assert self.patterns.label is not None, "every layout has labels"
        by_time = "time" in self.patterns.label.words
        folders = [folder / each for each in LABELS_OF.values()] if by_time else [folder]
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
    def _of_time(names: tuple[str, ...], split: str) -> tuple[str, ...]:
        return tuple(name for name in names if is_night(name) == split.endswith("_night"))

    def _of_lists(self, split: str) -> tuple[str, ...]:
        sources = self._sources(split) or (split,)
        names = tuple(name for source in sources for name in self._read_list(source))
        if len(sources) > 1:
            return tuple(sorted(names))
        return names if sources == (split,) else self._of_time(names, split)

    def _read_list(self, split: str) -> tuple[str, ...]:
        path = self.root / self._files[split]
        if not path.is_file():
            raise InputError(
                f"dataset.splits.{split}: the list '{path}' does not exist; write it (one name "
                "per line), or divide the labels on disk by their sets with dataset.lists=sets."
            )
        lines = read_names(path, f"dataset.splits.{split}")
        names = tuple(MODALITY.sub("_", line.removesuffix(".png")) for line in lines)
        for name in names:
            if NAME.fullmatch(name) is None:
                raise InputError(
                    f"dataset.splits.{split}: '{name}' in '{path}' is not {FORM}; correct the line."
                )
        return names

    def _of_sets(self, split: str) -> tuple[str, ...]:
        wanted = sets_of(split)
        return tuple(
            name for name in self.labels_on_disk if NAME.fullmatch(name) and set_of(name) in wanted
        )


def _holds_kp(root: Path) -> bool:
    images = ((root / each).is_dir() for each in ("images", "pseudo_KP"))
    return (root / "labels").is_dir() and any(images)


def _find_lists(root: Path, splits: dict[str, str], wanted: ListSource) -> Literal["files", "sets"]:
    """The source of the splits; with a changed `splits` it is files."""
    changed = dict(splits) != SPLITS
    if wanted == "sets":
        if changed:
            raise InputError(
                "dataset.splits names lists, but dataset.lists=sets does not use lists; omit one "
                "of them."
            )
        return "sets"
    exist = any((root / path).is_file() for path in splits.values())
    return "files" if wanted == "files" or exist or changed else "sets"
