"""Read MVSeg: RGB-thermal videos by day and at night with sparse labels of 26 classes."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.folder.frames import FolderFrame
from rgbt.data.folder.pattern import Pattern, in_order, what_is_in
from rgbt.data.images import PairPattern, PairReader
from rgbt.data.labels import LabelCodes
from rgbt.data.named_files import existing_root
from rgbt.data.video.dataset import VideoDataset
from rgbt.data.video.frames import Gaps, NumberedFrame
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

CLASSES = (
    *("background", "car", "bus", "motorcycle", "bicycle", "pedestrian", "motorcyclist"),
    *("bicyclist", "cart", "bench", "umbrella", "box", "pole", "street_lamp", "traffic_light"),
    *("traffic_sign", "car_stop", "color_cone", "sky", "road", "sidewalk", "curb", "vegetation"),
    *("terrain", "building", "ground"),
)
PALETTE = (
    *((0, 0, 0), (0, 0, 142), (0, 60, 100), (0, 0, 230), (119, 11, 32), (255, 0, 0)),
    *((0, 139, 139), (255, 165, 150), (192, 64, 0), (211, 211, 211), (100, 33, 128)),
    *((117, 79, 86), (153, 153, 153), (190, 122, 222), (250, 170, 30), (220, 220, 0)),
    *((222, 142, 35), (205, 155, 155), (70, 130, 180), (128, 64, 128), (244, 35, 232)),
    *((0, 0, 70), (107, 142, 35), (152, 251, 152), (70, 70, 70), (110, 80, 100)),
)
LISTS = {split: f"{split}.txt" for split in ("train", "val", "test", "test_day", "test_night")}

FOLDERS = {"visible": "v", "infrared": "i", "label": "l"}
"""Folder of a video -> last letter of the names of its files."""

PARTNERS = (
    *("data/{video}/infrared/{name}i.jpg", "data/{video}/infrared/{name}i.png"),
    "data/{video}/label/{name}l.png",
)
"""Thermal images and labels."""

STEM = re.compile(r"(\d*?)(\d{4})")
"""The frame number is the last four digits before the letter."""

APART = 20_000
"""Between the numbers of two recordings, so that 10000 does not follow 09999."""


class MVSeg(VideoDataset):
    """RGB-thermal videos with about five labelled frames each, in the layout of the MVSeg archive.

    Layout: {train,val,test,test_day,test_night}.txt, one name of a video per line, and
    data/VIDEO/visible/NNNNNv.jpg, data/VIDEO/infrared/NNNNNi.jpg (or png, as the first file of the
    folder), data/VIDEO/label/NNNNNl.png. The frame number is the last four digits; what is before
    them distinguishes recordings of one video.

    Value 255 of a label is ignored; the authors' code trains and scores it as "ground".

    Source: Ji et al., "Multispectral Video Semantic Segmentation: A Benchmark Dataset and
    Baseline", CVPR 2023.

    Args:
        root: folder that holds the lists and `data`.
        name: see `FileDataset`, as `num_classes`, `classes` and `palette`.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        lists: split -> list of videos in `root`.
        unlabelled_is: what value 255 means: "ignored", or "ground" as in the authors' code.
        gaps: see `rgbt.data.video.dataset.VideoDataset`.

    Raises:
        InputError: no such root, no videos in it, an empty video, or numbers of classes, names and
            colours that differ.
    """

    images = PairReader(
        layouts=(
            PairPattern("data/{video}/visible/{name}v.jpg", "data/{video}/infrared/{name}i.jpg"),
            PairPattern("data/{video}/visible/{name}v.png", "data/{video}/infrared/{name}i.png"),
        ),
        # JPEG stores grey images with three channels that may differ by rounding.
        most_tint=8,
    )

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        name: Text = "mvseg",
        num_classes: NumClasses = len(CLASSES),
        classes: Names = CLASSES,
        palette: tuple[Colour, ...] = PALETTE,
        background: Names = ("background",),
        lists: dict[Text, Text] = LISTS,
        unlabelled_is: Literal["ignored", "ground"] = "ignored",
        gaps: Gaps = "split",
    ) -> None:
        folder = existing_root(root, "that holds the lists of MVSeg and the folder data")
        super().__init__(
            *(folder, name, num_classes, classes, palette),
            lists=lists,
            gaps=gaps,
            background=background,
        )
        if unlabelled_is == "ground":
            self.check_classes(unlabelled_is=("ground",))
        rest = IGNORE if unlabelled_is == "ignored" else classes.index("ground")
        self.codes = LabelCodes({**{value: value for value in range(num_classes)}, IGNORE: rest})
        if not (folder / "data").is_dir():
            raise InputError(
                f"dataset.root: '{root}' does not hold the folder data; give the folder of the "
                "data set itself."
            )
        self.add(_frames(folder), [Pattern(each, "dataset.root") for each in PARTNERS])


def _frames(root: Path) -> Iterator[NumberedFrame]:
    """The frames of all videos; InputError for a video without RGB images."""
    for folder in sorted((root / "data").iterdir(), key=lambda path: in_order(path.name)):
        if not folder.is_dir() or folder.name.startswith("."):
            continue
        rgb = _images(folder / "visible", "v")
        if not rgb:
            raise InputError(
                f"video '{folder.name}' is empty: {folder / 'visible'} holds "
                f"{what_is_in(folder / 'visible')}, expected files such as 00001v.jpg; unpack it "
                "again, or remove the folder."
            )
        thermal = _images(folder / "infrared", "i")
        ending = next(iter(thermal.values())).suffix if thermal else next(iter(rgb.values())).suffix
        for stem, path in rgb.items():
            yield _frame(folder, stem, path, thermal.get(stem) or _at(folder, stem, ending))


def _at(folder: Path, stem: str, ending: str) -> Path:
    return folder / "infrared" / f"{stem}i{ending}"


def _frame(folder: Path, stem: str, rgb: Path, thermal: Path) -> NumberedFrame:
    match = STEM.fullmatch(stem)
    if match is None:
        raise InputError(
            f"{rgb} is no frame of MVSeg: expected a number of four digits or more before the "
            "letter v, such as 00237v.jpg."
        )
    video = folder.name
    files = FolderFrame(
        name=f"{video}_{stem}",
        values={"video": video, "name": stem},
        rgb=rgb,
        thermal=thermal,
        label=folder / "label" / f"{stem}l.png",
    )
    return NumberedFrame(video, int(match[2]) + APART * int(match[1] or 0), files)


def _images(folder: Path, letter: str) -> dict[str, Path]:
    """Stem without the letter -> file, of the ending that the first file has."""
    paths = sorted(path for path in folder.glob(f"*{letter}.*") if path.name[0] != ".")
    known = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg", ".png")]
    return {path.stem[:-1]: path for path in known if path.suffix == known[0].suffix}
