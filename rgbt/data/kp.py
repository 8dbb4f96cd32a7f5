"""Read KP: the KAIST multispectral street scenes with labels of the 19 classes of Cityscapes."""

from __future__ import annotations

import re
import shutil
from functools import cached_property
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.file_dataset import DAY_OR_NIGHT, FileDataset, SplitNames
from rgbt.data.images import PairReader
from rgbt.data.labels import indices
from rgbt.data.patterns import FrameFiles, Pattern, Patterns
from rgbt.ranges import Colour, Names, NumClasses, Text

# Class -> its colour, in the order of the indices.
COLOURS = {
    "road": (128, 64, 128),
    "sidewalk": (244, 35, 232),
    "building": (70, 70, 70),
    "wall": (102, 102, 156),
    "fence": (190, 153, 153),
    "pole": (153, 153, 153),
    "traffic_light": (250, 170, 30),
    "traffic_sign": (220, 220, 0),
    "vegetation": (107, 142, 35),
    "terrain": (152, 251, 152),
    "sky": (70, 130, 180),
    "person": (220, 20, 60),
    "rider": (255, 0, 0),
    "car": (0, 0, 142),
    "truck": (0, 0, 70),
    "bus": (0, 60, 100),
    "train": (0, 80, 100),
    "motorcycle": (0, 0, 230),
    "bicycle": (119, 11, 32),
}
CLASSES, PALETTE = tuple(COLOURS), tuple(COLOURS.values())
PATTERNS = (
    "images/{set}/{video}/visible/{frame}.jpg",
    "images/{set}/{video}/lwir/{frame}.jpg",
    "labels/{set}_{video}_{frame}.png",
)
# Recordings of each split, as the lists of the CRM release divide the labelled images.
SETS = {"train": (0, 1, 2, 3, 4, 5), "val": (6, 10), "test": (7, 8, 9, 11)}

NIGHT_SETS = (3, 4, 5, 9, 10, 11)
SETS_OF = {
    f"{split}{time}": tuple(n for n in sets if not time or (n in NIGHT_SETS) == (time == "_night"))
    for split, sets in SETS.items()
    for time in ("", *DAY_OR_NIGHT)
}
SPLITS = {split: f"{split}.txt" for split in SETS_OF}
NAME = re.compile(r"(?P<set>set(?:0\d|1[01]))_(?P<video>V\d{3})_(?P<frame>I\d{5})")


def parts_of(name: str) -> dict[str, str]:
    """Split `name` into set, video and frame, as set00, V000, I00050; InputError if invalid."""
    match = NAME.fullmatch(name)
    if match is None:
        raise InputError(f"'{name}' is not a name such as set00_V000_I00050, of a set up to 11.")
    return match.groupdict()


def set_of(name: str) -> int:
    """Return the number of the recording of `name`; InputError if the name is invalid."""
    return int(parts_of(name)["set"].removeprefix("set"))


class KP(FileDataset):
    """Reads RGB-thermal street scenes by day and night, as the CRM release lays them out.

    Layout (XX is the set, 00 to 11; a name of this data set is setXX_VYYY_IZZZZZ):
    images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg and labels/setXX_VYYY_IZZZZZ.png.

    Splits: "train", "val", "test" and the day and night of each. Lists hold one name per line, with
    or without .png. Where there are none, the labels on disk are divided by set numbers, as in the
    CRM release. Label files hold 0 to K - 1 and K (19) for void, which becomes 255.

    Thermal is the mean over the three channels of the lwir image, rounded. If channels differ, the
    releases disagree: CRM takes the real mean, OpenRSS truncates it. A difference of up to 8 levels
    is accepted, as of a grey JPEG that was saved in colour.

    Source: images KAIST multispectral pedestrian data set (Hwang et al., CVPR 2015); labels MS-UDA
    (Kim et al., RA-L 2021); split CRM (Shin et al., ICRA 2024).
    """

    images = PairReader(
        layouts=(Patterns.of(*PATTERNS[:2]),),
        most_tint=8,
        advice="use the original file of the folder lwir",
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
        lists: Literal["auto", "sets"] = "auto",
    ) -> None:
        super().__init__(root, name, num_classes, classes, palette, background=background)
        if not all((self.root / folder).is_dir() for folder in ("images", "labels")):
            raise InputError(f"dataset.root: '{root}' does not hold the folders images and labels.")
        self.codes = indices(num_classes, num_classes)  # the value after the last class is void
        self.patterns = Patterns.of(*PATTERNS)
        exist = any((self.root / path).is_file() for path in splits.values())
        self.by_set = lists == "sets" or not (exist or splits != SPLITS)
        by_set = {split: f"labels of the sets {list(sets)}" for split, sets in SETS_OF.items()}
        self.splits = by_set if self.by_set else dict(splits)

    def listed(self, split: str) -> tuple[str, ...]:
        """Return names of a split, in its list's order, or sorted; InputError for invalid ones."""
        if self.by_set:
            return tuple(name for name in self._labels if set_of(name) in SETS_OF[split])
        names = tuple(line.removesuffix(".png") for line in self.lines(split))
        self.nights(names)  # refuses invalid names
        return names

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`; InputError if the name is invalid."""
        return self.patterns.frame(self.root, name, parts_of(name))

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...]:
        """Say which images were taken at night, by set number; InputError for other names."""
        return tuple(set_of(name) in NIGHT_SETS for name in names)

    def unused(self, lists: SplitNames) -> list[Path]:
        """Return labels of no split; images without a label are many and not meant."""
        listed = set().union(*lists.values())
        return [path for name, path in self._labels.items() if name not in listed]

    @cached_property
    def _labels(self) -> dict[str, Path]:
        """Return the label file of each name, sorted, of all that are there; listed once."""
        files = Pattern(PATTERNS[2], "dataset.root").files(self.root)
        return {path.stem: path for path in files if NAME.fullmatch(path.stem)}


def pick_kp(kaist: Path, labels: Path, out: Path) -> int:
    """Copy the labelled images of KAIST, 950 of 95,000 pairs, to a new folder in the layout of KP.

    Args:
        kaist: download, with setXX/VYYY/{visible,lwir}/IZZZZZ.jpg.
        labels: those of MS-UDA; of its folders only those drawn by hand are read, val_day and
            val_night. InputError if there are none, or if an image is missing.
        out: new folder.

    Returns:
        number of pairs.
    """
    found = {path.stem: path for path in sorted(labels.rglob("set*.png"))}
    by_hand = {n: path for n, path in found.items() if path.parent.name.startswith("val_")}
    copies: dict[Path, Path] = {}
    for name, label in (by_hand or found).items():
        rgb, thermal, target = (out / text.format(**parts_of(name)) for text in PATTERNS)
        images = {path: kaist / path.relative_to(out / "images") for path in (rgb, thermal)}
        copies |= {target: label, **images}
    missing = [path for path in copies.values() if not path.is_file()]
    if missing or not copies:
        first = f"{len(missing)} files, such as {missing[0]}" if missing else f"labels in {labels}"
        raise InputError(f"expected {first}; give the whole of KAIST and the labels of MS-UDA.")
    for path, original in copies.items():
        path.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(original, path)
    return len(copies) // 3
