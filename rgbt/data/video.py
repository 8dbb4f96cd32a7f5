"""Read videos of RGB-thermal frames: MVSeg, and any folder of numbered frames.

A sequence is a run of frames with equal steps between their numbers, as the data set or its names
say; a pair of consecutive frames are two neighbours of one sequence.
"""

from __future__ import annotations

import os
import re
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from itertools import pairwise, zip_longest
from pathlib import Path
from typing import Literal

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset, SplitNames, hash_of_files
from rgbt.data.images import PairReader, Range
from rgbt.data.labels import LabelCodes, LabelValue, label_codes, painted
from rgbt.data.patterns import (
    NAME,
    Frame,
    Pattern,
    Patterns,
    find_frames,
    in_order,
    without_rgb,
)
from rgbt.dataset import DatasetWrapper, LabelledDataset, reader_of
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

# What a missing number in a video means: an error, or the beginning of another sequence.
Gaps = Literal["refuse", "split"]

Sequences = tuple[tuple[str, ...], ...]

VIDEO = "video"  # the word of the patterns that names one

CLASSES = (
    "background",
    "car",
    "bus",
    "motorcycle",
    "bicycle",
    "pedestrian",
    "motorcyclist",
    "bicyclist",
    "cart",
    "bench",
    "umbrella",
    "box",
    "pole",
    "street_lamp",
    "traffic_light",
    "traffic_sign",
    "car_stop",
    "color_cone",
    "sky",
    "road",
    "sidewalk",
    "curb",
    "vegetation",
    "terrain",
    "building",
    "ground",
)
PALETTE = (
    (0, 0, 0),
    (0, 0, 142),
    (0, 60, 100),
    (0, 0, 230),
    (119, 11, 32),
    (255, 0, 0),
    (0, 139, 139),
    (255, 165, 150),
    (192, 64, 0),
    (211, 211, 211),
    (100, 33, 128),
    (117, 79, 86),
    (153, 153, 153),
    (190, 122, 222),
    (250, 170, 30),
    (220, 220, 0),
    (222, 142, 35),
    (205, 155, 155),
    (70, 130, 180),
    (128, 64, 128),
    (244, 35, 232),
    (0, 0, 70),
    (107, 142, 35),
    (152, 251, 152),
    (70, 70, 70),
    (110, 80, 100),
)
LISTS = {split: f"{split}.txt" for split in ("train", "val", "test", "test_day", "test_night")}

# The frame number of MVSeg is the last four digits before the letter.
STEM = re.compile(r"(\d*?)(\d{4})")

# Distance of the numbers of two recordings of MVSeg, so that 10000 does not follow 09999.
RECORDING_GAP = 20_000


KINDS = ("jpg", "png")
LAYOUTS = tuple(
    Patterns.of(
        f"data/{{video}}/visible/{{name}}v.{kind}",
        f"data/{{video}}/infrared/{{name}}i.{kind}",
        "data/{video}/label/{name}l.png",
    )
    for kind in KINDS
)


class VideoDataset(FileDataset):
    """Base of data sets of videos; a subclass finds the frames and calls `add`.

    `names` of a split are its labelled frames, for training and evaluation; all frames where the
    split has no label. `sequences` are all frames, for temporal consistency.

    Attributes:
        frames: name -> files; the value of {video} is the video, "" if the whole data set is one.
        videos: name of a video -> number -> name of the frame.
    """

    splits_key = "dataset.lists"

    def add(
        self,
        frames: Iterable[tuple[int, Frame]],
        partners: Sequence[Pattern | None],
        lists: dict[str, str] | None,
        gaps: Gaps,
    ) -> None:
        """Use these frames of all videos, each with its number.

        `partners` are the patterns of thermal images and labels; `lists`: split -> list of videos,
        None: the split "test" is all; `gaps`: what a missing number in a video means. InputError:
        two frames of a video have one number.
        """
        self._partners, self.gaps, self._is_listed = partners, gaps, lists is not None
        self.splits = {"test": "all videos"} if lists is None else dict(lists)
        self.frames: dict[str, Frame] = {}
        videos: dict[str, dict[int, str]] = {}
        for number, frame in sorted(frames, key=lambda each: each[0]):
            # A broken link is kept; reading it says where it leads.
            has_label = frame.label is not None and os.path.lexists(frame.label)
            self.frames[frame.name] = frame if has_label else frame._replace(label=None)
            known = videos.setdefault(_video_of(frame), {})
            if number in known:
                raise InputError(
                    f"video '{_video_of(frame)}' has two frames with the number {number}, "
                    f"'{known[number]}' and '{frame.name}'; rename one of them."
                )
            known[number] = frame.name
        self.videos = {video: videos[video] for video in sorted(videos, key=in_order)}

    def videos_of(self, split: str) -> tuple[str, ...]:
        """Names of the videos of a split; InputError if one of them is not there, or empty."""
        self.check_split(split)
        names = dict.fromkeys(self.lines(split) if self._is_listed else self.videos)
        for name in names:
            if name not in self.videos:
                raise InputError(
                    f"dataset.lists.{split}: video '{name}' has no frames in {self.root}; expected "
                    f"{self.images.layouts[0]}."
                )
        return tuple(names)

    def all_names(self, split: str) -> tuple[str, ...]:
        """Names of all frames of a split, labelled or not."""
        return tuple(
            name for video in self.videos_of(split) for name in self.videos[video].values()
        )

    def sequences(self, split: str) -> Sequences:
        """Names of all frames of a split, one tuple for each run without a gap.

        InputError: a video is empty, or, with gaps="refuse", lacks a number or an image.
        """
        videos = self.videos_of(split)
        problems = self._gaps(videos) + self._unpaired(videos) if self.gaps == "refuse" else []
        if problems:
            raise InputError(
                f"{problems[0]}; restore it, or set dataset.gaps=split to begin another sequence "
                "after each gap."
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
        return self.frames[name]

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether the video of each name is in a list of a split "..._night", or "..._day".

        A video in neither list is a day video where its split has a list of the night alone. None
        if a video is in no list at all.
        """
        if not self._is_listed:
            return None
        listed = {split: set(self.lines(split)) for split in self.splits}
        at_night, by_day = set[str](), set[str]()
        for split, videos in listed.items():
            whole, _, part = split.rpartition("_")
            at_night |= videos if part == "night" else set()
            by_day |= {"night": listed.get(whole, set()), "day": videos}.get(part, set())
        found = {_video_of(self.frames[name]) for name in names}
        if not found <= at_night | by_day:
            return None
        return tuple(_video_of(self.frames[name]) in at_night for name in names)

    def fingerprint(self) -> str:
        """See `hash_of_files`; of all frames, labelled or not."""
        return hash_of_files({s: self.all_names(s) for s in self.splits}, self.files)

    def unused(self, lists: SplitNames) -> Collection[Path]:  # noqa: ARG002 - as every data set
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
        no_rgb = [
            f"{path} has no RGB image"
            for path, v in without_rgb(self.root, self._partners, self.frames.values()).items()
            if videos is None or v.get(VIDEO, "") in videos
        ]
        no_thermal = [
            f"the frame '{name}' has no thermal image {frame.thermal}"
            for name, frame in self.frames.items()
            if (videos is None or _video_of(frame) in videos) and name not in read
            if not os.path.lexists(frame.thermal)
        ]
        return no_rgb + no_thermal


def _video_of(frame: Frame) -> str:
    return frame.values.get(VIDEO, "")


class Video(VideoDataset):
    """Numbered RGB-thermal frames in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.patterns`): {name} is the
    frame, whose last number counts, and {video} its video, if there are several. The name of a
    sample is that of its video and that of its frame, joined by "_".
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
        common = (root, name, num_classes, classes, colours)
        super().__init__(*common, background=background, unscored=unscored)
        self.codes = label_codes(classes, ids, None, ignored)
        self.follow(rgb, thermal, label, thermal_range)
        frames: list[tuple[int, Frame]] = []
        for frame in find_frames(self.root, self.patterns).values():
            found = re.findall(r"\d+", frame.values[NAME])
            if not found:
                raise InputError(f"the frame {frame.rgb} of a video has no number in its name.")
            frames.append((int(found[-1]), frame))
        self.add(frames, self.patterns[1:], lists, gaps)


class MVSeg(VideoDataset):
    """RGB-thermal videos with about five labelled frames each, in the layout of the MVSeg archive.

    Layout: {train,val,test,test_day,test_night}.txt, one name of a video per line, and
    data/VIDEO/visible/NNNNNv.jpg, data/VIDEO/infrared/NNNNNi.jpg (or png),
    data/VIDEO/label/NNNNNl.png. The frame number is the last four digits; what is before
    them distinguishes recordings of one video.

    Value 255 of a label is ignored; the authors' code trains and scores it as "ground".

    Source: Ji et al., "Multispectral Video Semantic Segmentation: A Benchmark Dataset and
    Baseline", CVPR 2023.
    """

    # JPEG stores grey images with three channels that may differ by rounding.
    images = PairReader(layouts=tuple(each._replace(label=None) for each in LAYOUTS), most_tint=8)

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
        frames: list[tuple[int, Frame]] = []
        found = [each.frames(self.root) for each in LAYOUTS]
        for frame in (found[0] | found[1]).values():
            stem = frame.values[NAME]
            match = STEM.fullmatch(stem)
            if match is None:
                raise InputError(
                    f"{frame.rgb} is no frame of MVSeg: expected a number of four digits or more "
                    "before the letter v, such as 00237v.jpg."
                )
            others = [frame.thermal.with_name(f"{stem}i.{kind}") for kind in KINDS]
            thermal = next((path for path in others if os.path.lexists(path)), frame.thermal)
            number = int(match[2]) + RECORDING_GAP * int(match[1] or 0)
            frames.append((number, frame._replace(thermal=thermal)))
        partners = [each for layout in LAYOUTS for each in layout[1:]]
        self.add(frames, partners, lists, gaps)


class FramesInOrder(DatasetWrapper):
    """All frames of the sequences of `split`, instead of the labelled ones in the order of a list.

    Attributes:
        sequences: names of each sequence, in the order of their frames; two or more each.
        alone: number of frames without a neighbour, which are left out.

    Raises:
        InputError: no two frames of the split follow each other.
    """

    def __init__(self, source: LabelledDataset, split: str) -> None:
        super().__init__(source)
        reader = reader_of(source)
        if isinstance(reader, VideoDataset):
            every = reader.sequences(split)
        else:
            every = sequences_of_names(source.names(split))
        self.sequences = tuple(each for each in every if len(each) > 1)
        self.alone = sum(len(each) == 1 for each in every)
        if not self.sequences:
            raise InputError(
                f"split '{split}' of {source.name} has no two consecutive frames among its "
                f"{self.alone} frame(s); frames=video requires names whose numbers follow each "
                "other, such as 00101D and 00102D."
            )
        self._frames = tuple(name for each in self.sequences for name in each)
        self._split = split

    @property
    def pairs(self) -> dict[str, str]:
        """Second frame -> the frame before it."""
        return {later: name for each in self.sequences for name, later in pairwise(each)}

    def names(self, split: str) -> tuple[str, ...]:
        """All frames in order; of another split as the source has them."""
        return self._frames if split == self._split else self.source.names(split)


def sequences_of_names(names: Iterable[str]) -> Sequences:
    """Runs of names that are equal but for their last number, and whose numbers are consecutive.

    Consecutive are numbers that differ by the smallest step that occurs between such names, so that
    every fifth frame of a video is a sequence too. Names without a number are alone.
    """
    groups: dict[tuple[str, str], dict[int, str]] = {}
    others: list[str] = []
    for name in dict.fromkeys(names):
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", name)
        if match is None:
            others.append(name)
        else:
            groups.setdefault((match[1], match[3]), {})[int(match[2])] = name
    runs = [run for _, frames in sorted(groups.items()) for run in consecutive(frames)]
    return (*runs, *((name,) for name in others))


def consecutive(frames: Mapping[int, str]) -> Iterator[tuple[str, ...]]:
    """Frames by number, cut where these are further apart than the smallest step."""
    numbers = sorted(frames)
    steps = [later - number for number, later in pairwise(numbers)]
    usual = min(steps, default=1)
    run: list[str] = []
    for number, after in zip_longest(numbers, steps):
        run.append(frames[number])
        if after != usual:
            yield tuple(run)
            run = []
