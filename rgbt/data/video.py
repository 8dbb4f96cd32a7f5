"""Read videos of RGB-thermal frames: MVSeg, and any folder of numbered frames."""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Literal, NamedTuple

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset, SplitNames, hash_of_files
from rgbt.data.images import PairPattern, PairReader, Range
from rgbt.data.labels import LabelCodes, LabelValue, label_codes, painted
from rgbt.data.patterns import NAME, Frame, Pattern, find_frames, in_order, without_rgb
from rgbt.data.sequences import consecutive
from rgbt.data.splits import ByList
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

Gaps = Literal["refuse", "split"]
"""What a missing number in a video means: an error, or the beginning of another sequence."""

VIDEO = "video"
"""The word of the patterns that names a video."""

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

STEM = re.compile(r"(\d*?)(\d{4})")
"""The frame number of MVSeg is the last four digits before the letter."""

APART = 20_000
"""Between the numbers of two recordings of MVSeg, so that 10000 does not follow 09999."""


class NumberedFrame(NamedTuple):
    """A frame of a video.

    Attributes:
        video: its name; "" where the whole data set is one video.
        number: of the frame.
        files: its images, and where its label is expected.
    """

    video: str
    number: int
    files: Frame


class VideoDataset(FileDataset):
    """Base of data sets of videos; a subclass finds the frames and calls `add`.

    `names` of a split are its labelled frames, for training and evaluation; all frames where the
    split has no label. `sequences` are all frames, for temporal consistency.

    Attributes:
        frames: name -> frame.
        videos: name of a video -> number -> name of the frame.
    """

    splits_key = "dataset.lists"

    def add(
        self,
        frames: Iterable[NumberedFrame],
        partners: Sequence[Pattern | None],
        lists: dict[str, str] | None,
        gaps: Gaps,
    ) -> None:
        """Use these frames.

        Args:
            frames: of all videos.
            partners: patterns of their thermal images and labels.
            lists: split -> list of names of videos in `root`; None: the split "test" is all videos.
            gaps: what a missing number in a video means.

        Raises:
            InputError: two frames of a video have one number.
        """
        self._partners, self.gaps = partners, gaps
        self._lists = None if lists is None else ByList(self.root, dict(lists))
        self.frames: dict[str, NumberedFrame] = {}
        self.videos: dict[str, dict[int, str]] = {}
        for frame in sorted(frames, key=lambda each: each.number):
            files = frame.files
            # A broken link is kept; reading it says where it leads.
            if files.label is not None and not os.path.lexists(files.label):
                files = files._replace(label=None)
            known = self.videos.setdefault(frame.video, {})
            if frame.number in known:
                raise InputError(
                    f"video '{frame.video}' has two frames with the number {frame.number}, "
                    f"'{known[frame.number]}' and '{files.name}'; rename one of them."
                )
            known[frame.number] = files.name
            self.frames[files.name] = frame._replace(files=files)
        self.videos = {video: self.videos[video] for video in sorted(self.videos, key=in_order)}

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its list."""
        return {"test": "all videos"} if self._lists is None else self._lists.splits

    def videos_of(self, split: str) -> tuple[str, ...]:
        """Names of the videos of a split; InputError if one of them is not there, or empty."""
        self.check_split(split)
        if self._lists is None:
            return tuple(self.videos)
        names = self._lists.names(split)
        for name in names:
            if name not in self.videos:
                raise InputError(
                    f"dataset.lists.{split}: video '{name}' has no frames in {self.root}; expected "
                    f"{self.images.layouts[0]}."
                )
        return tuple(dict.fromkeys(names))

    def all_names(self, split: str) -> tuple[str, ...]:
        """Names of all frames of a split, labelled or not."""
        return tuple(
            name for video in self.videos_of(split) for name in self.videos[video].values()
        )

    def sequences(self, split: str) -> tuple[tuple[str, ...], ...]:
        """Names of all frames of a split, one tuple for each run without a gap.

        Raises:
            InputError: a video of the list is empty, or, with gaps="refuse", lacks a number, an RGB
                image or a thermal image.
        """
        videos = self.videos_of(split)
        if self.gaps == "refuse":
            problems = [*self._gaps(videos), *self._unpaired(videos)]
            if problems:
                raise InputError(
                    f"{problems[0]}; restore it, or set dataset.gaps=split to begin another "
                    "sequence after each gap."
                )
        return tuple(run for video in videos for run in consecutive(self.videos[video]))

    def listed(self, split: str) -> tuple[str, ...]:
        """Labelled frames of a split, video by video; all frames where none is labelled."""
        every = self.all_names(split)
        return tuple(name for name in every if self.frame(name).label is not None) or every

    def frame(self, name: str) -> Frame:
        """The files of `name`; no label where there was none when the folder was listed."""
        if name not in self.frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self.frames[name].files

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether the video of each name is in a list of a split "..._night", or "..._day".

        A video in neither list is a day video where its split has a list of the night alone. None
        if a video is in no list at all.
        """
        if self._lists is None:
            return None
        listed = {split: set(self._lists.names(split)) for split in self.splits}
        at_night, by_day = set[str](), set[str]()
        for split, videos in listed.items():
            whole, _, part = split.rpartition("_")
            if part == "night":
                at_night |= videos
                by_day |= listed.get(whole, set())
            elif part == "day":
                by_day |= videos
        found = [self.frames[name].video for name in names]
        if not set(found) <= at_night | by_day:
            return None
        return tuple(video in at_night for video in found)

    def fingerprint(self) -> str:
        """See `hash_of_files`; of all frames, labelled or not."""
        return hash_of_files({s: self.all_names(s) for s in self.splits}, self.files)

    def unused(self, lists: SplitNames) -> Iterable[Path]:  # noqa: ARG002 - as every data set
        """None: frames without a label belong to a video, for the rest see `own_problems`."""
        return ()

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Frames without an RGB image, or without a thermal image, of any split."""
        return [f"{each}." for each in self._unpaired(None, set().union(*lists.values()))]

    def _gaps(self, videos: Iterable[str]) -> list[str]:
        """Numbers that are missing; frames are apart by the smallest step of all videos."""
        steps = [b - a for frames in self.videos.values() for a, b in pairwise(frames)]
        return [
            f"video '{video}' lacks frame {a + min(steps)}, which should follow "
            f"'{self.videos[video][a]}'"
            for video in videos
            for a, b in pairwise(self.videos[video])
            if b - a != min(steps)
        ]

    def _unpaired(self, videos: Collection[str] | None, read: Collection[str] = ()) -> list[str]:
        """What videos lack (None: all), as beginnings of sentences, but for frames in `read`."""
        files = [each.files for each in self.frames.values()]
        no_rgb = [
            f"{path} has no RGB image"
            for path, values in without_rgb(self.root, self._partners, files)
            if videos is None or values.get(VIDEO, "") in videos
        ]
        no_thermal = [
            f"the frame '{name}' has no thermal image {frame.files.thermal}"
            for name, frame in self.frames.items()
            if (videos is None or frame.video in videos) and name not in read
            if not os.path.lexists(frame.files.thermal)
        ]
        return no_rgb + no_thermal


class Video(VideoDataset):
    """Numbered RGB-thermal frames in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.patterns`): {name} is the
    frame, whose last number counts, and {video} its video, if there are several. The name of a
    sample is that of its video and that of its frame, joined by "_".

    Arguments: the keys of conf/dataset/video.yaml, which describes each. InputError: no such
    root, another layout, or settings that do not fit each other.
    """

    def __init__(  # noqa: PLR0913 - each is a key of the configuration
        self,
        root: Text,
        *,
        num_classes: NumClasses,
        classes: Names,
        rgb: Text,
        thermal: Text,
        label: Text | None,
        name: Text = "video",
        palette: tuple[Colour, ...] | None = None,
        unscored: Names = (),
        background: Names = (),
        lists: dict[Text, Text] | None = None,
        gaps: Gaps = "refuse",
        ids: dict[LabelValue, Text] | None = None,
        ignored: tuple[LabelValue, ...] = (),
        thermal_range: Range | None = None,
    ) -> None:
        colours = painted(num_classes) if palette is None else palette
        super().__init__(
            *(root, name, num_classes, classes, colours),
            background=background,
            unscored=unscored,
        )
        self.codes = label_codes(classes, ids, None, ignored)
        self.follow(rgb, thermal, label, thermal_range)
        frames = find_frames(self.root, self.patterns).values()
        numbered = [NumberedFrame(f.values.get(VIDEO, ""), _number_of(f), f) for f in frames]
        self.add(numbered, self.patterns[1:], lists, gaps)


class MVSeg(VideoDataset):
    """RGB-thermal videos with about five labelled frames each, in the layout of the MVSeg archive.

    Layout: {train,val,test,test_day,test_night}.txt, one name of a video per line, and
    data/VIDEO/visible/NNNNNv.jpg, data/VIDEO/infrared/NNNNNi.jpg (or png, as the first file of the
    folder), data/VIDEO/label/NNNNNl.png. The frame number is the last four digits; what is before
    them distinguishes recordings of one video.

    Value 255 of a label is ignored; the authors' code trains and scores it as "ground".

    Source: Ji et al., "Multispectral Video Semantic Segmentation: A Benchmark Dataset and
    Baseline", CVPR 2023.

    Arguments: the keys of conf/dataset/mvseg.yaml, which describes each. InputError: no such
    root, another layout, or settings that do not fit each other.
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
        super().__init__(root, name, num_classes, classes, palette, background=background)
        rest = IGNORE
        if unlabelled_is == "ground":
            self.check_classes(unlabelled_is=("ground",))
            rest = classes.index("ground")
        self.codes = LabelCodes({**{value: value for value in range(num_classes)}, IGNORE: rest})
        if not (self.root / "data").is_dir():
            raise InputError(f"dataset.root: '{root}' does not hold the folder data.")
        frames: list[NumberedFrame] = []
        for folder in sorted(self.root.glob("data/[!.]*/visible"), key=lambda p: in_order(str(p))):
            rgb, thermal = _images(folder, "v"), _images(folder.with_name("infrared"), "i")
            ending = next(iter((thermal or rgb).values()), folder).suffix
            for stem, path in rgb.items():
                expected = folder.with_name("infrared") / f"{stem}i{ending}"
                frames.append(_frame(stem, path, thermal.get(stem, expected)))
        texts = [f"data/{{video}}/infrared/{{name}}i.{kind}" for kind in ("jpg", "png")]
        texts += ["data/{video}/label/{name}l.png"]
        self.add(frames, [Pattern(each, "dataset.root") for each in texts], lists, gaps)


def _number_of(frame: Frame) -> int:
    found = re.findall(r"\d+", frame.values[NAME])
    if not found:
        raise InputError(f"the frame {frame.rgb} of a video has no number in its name.")
    return int(found[-1])


def _images(folder: Path, letter: str) -> Mapping[str, Path]:
    """Stem without the letter -> file, of the ending that the first file has."""
    paths = sorted(path for path in folder.glob(f"[!.]*{letter}.*"))
    known = [path for path in paths if path.suffix.lower() in (".jpg", ".jpeg", ".png")]
    return {path.stem[:-1]: path for path in known if path.suffix == known[0].suffix}


def _frame(stem: str, rgb: Path, thermal: Path) -> NumberedFrame:
    match = STEM.fullmatch(stem)
    if match is None:
        raise InputError(
            f"{rgb} is no frame of MVSeg: expected a number of four digits or more before the "
            "letter v, such as 00237v.jpg."
        )
    video = rgb.parents[1]
    label = video / "label" / f"{stem}l.png"
    values = {"video": video.name, "name": stem}
    files = Frame(f"{video.name}_{stem}", values, rgb, thermal, label)
    return NumberedFrame(video.name, int(match[2]) + APART * int(match[1] or 0), files)
