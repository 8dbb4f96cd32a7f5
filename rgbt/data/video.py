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
from rgbt.data.images import PairReader
from rgbt.data.labels import LabelCodes, LabelValue, label_codes, painted
from rgbt.data.patterns import (
    NAME,
    FrameFiles,
    Pattern,
    Patterns,
    find_frames,
    in_order,
    without_rgb,
)
from rgbt.data.thermal import ThermalRange
from rgbt.dataset import LabelledDataset, reader_of
from rgbt.ranges import Colour, Names, NumClasses, Text
from rgbt.types import IGNORE

# What a missing number in a video means: an error, or the beginning of another sequence.
Gaps = Literal["refuse", "split"]

Sequences = tuple[tuple[str, ...], ...]

VIDEO = "video"  # the word of the patterns that names one

# Class -> its colour, in the order of the indices.
COLOURS = {
    "background": (0, 0, 0),
    "car": (0, 0, 142),
    "bus": (0, 60, 100),
    "motorcycle": (0, 0, 230),
    "bicycle": (119, 11, 32),
    "pedestrian": (255, 0, 0),
    "motorcyclist": (0, 139, 139),
    "bicyclist": (255, 165, 150),
    "cart": (192, 64, 0),
    "bench": (211, 211, 211),
    "umbrella": (100, 33, 128),
    "box": (117, 79, 86),
    "pole": (153, 153, 153),
    "street_lamp": (190, 122, 222),
    "traffic_light": (250, 170, 30),
    "traffic_sign": (220, 220, 0),
    "car_stop": (222, 142, 35),
    "color_cone": (205, 155, 155),
    "sky": (70, 130, 180),
    "road": (128, 64, 128),
    "sidewalk": (244, 35, 232),
    "curb": (0, 0, 70),
    "vegetation": (107, 142, 35),
    "terrain": (152, 251, 152),
    "building": (70, 70, 70),
    "ground": (110, 80, 100),
}
CLASSES, PALETTE = tuple(COLOURS), tuple(COLOURS.values())
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
    """Reads the frames of videos, which a subclass finds and passes to `add`.

    `names` of a split are its labelled frames, for training and evaluation; all frames where the
    split has no label. `sequences` are all frames, for temporal consistency.

    Attributes:
        frames: name -> files; the value of {video} is the video, "" if the whole data set is one.
        videos: name of a video -> number -> name of the frame.
    """

    splits_key = "dataset.lists"

    def add(
        self,
        frames: Iterable[tuple[int, FrameFiles]],
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
        self.frames: dict[str, FrameFiles] = {}
        videos: dict[str, dict[int, str]] = {}
        for number, frame in sorted(frames, key=lambda numbered: numbered[0]):
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
        """Return the videos of a split; InputError if one of them is not there, or empty."""
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
        """Return the names of all frames of a split, labelled or not."""
        return tuple(
            name for video in self.videos_of(split) for name in self.videos[video].values()
        )

    def sequences(self, split: str) -> Sequences:
        """Return the names of all frames of a split, one tuple for each run without a gap.

        InputError: a video is empty, or, with gaps="refuse", lacks a number or an image.
        """
        videos = self.videos_of(split)
        problems = self._gaps(videos) + self._unpaired(videos) if self.gaps == "refuse" else []
        if problems:
            raise InputError(
                f"{problems[0]}; restore it, set dataset.gaps=split to begin another sequence "
                "after each gap, or pair videos of different rates or starts with rgbt align "
                "rgb=... thermal=..."
            )
        return tuple(run for video in videos for run in consecutive(self.videos[video]))

    def listed(self, split: str) -> tuple[str, ...]:
        """Return the labelled frames of a split, video by video; all where none is labelled."""
        every = self.all_names(split)
        return tuple(name for name in every if self.frame(name).label is not None) or every

    def frame(self, name: str) -> FrameFiles:
        """Return the files of `name`; no label where there was none when the folder was listed."""
        if name not in self.frames:
            raise InputError(f"{self.name} ({self.root}) has no frame called '{name}'.")
        return self.frames[name]

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Say whether the video of each name is in a list of a split "..._night", or "..._day".

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
        """Return `hash_of_files` of all frames, labelled or not."""
        return hash_of_files({s: self.all_names(s) for s in self.splits}, self.files)

    def unused(self, lists: SplitNames) -> Collection[Path]:  # noqa: ARG002 - as every data set
        """Return nothing: unlabelled frames belong to a video, for the rest see `own_problems`."""
        return ()

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Return frames without an RGB image, or without a thermal image, of any split."""
        read = {name for names in lists.values() for name in names}
        return [f"{problem}." for problem in self._unpaired(None, read)]

    def _gaps(self, videos: Iterable[str]) -> list[str]:
        """Say which numbers are missing; frames are apart by the smallest step of all videos."""
        steps = [b - a for frames in self.videos.values() for a, b in pairwise(frames)]
        step = min(steps, default=1)
        problems = []
        for video in videos:
            for number, after in pairwise(self.videos[video]):
                if after - number != step:
                    before = self.videos[video][number]
                    lacks = f"video '{video}' lacks frame {number + step}"
                    problems.append(f"{lacks}, which should follow '{before}'")
        return problems

    def _unpaired(self, videos: Collection[str] | None, read: Collection[str] = ()) -> list[str]:
        """Begin sentences that say what videos lack (None: all), but for frames in `read`."""
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


def _video_of(frame: FrameFiles) -> str:
    return frame.values.get(VIDEO, "")


class Video(VideoDataset):
    """Reads numbered RGB-thermal frames in any folder whose paths follow patterns.

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
        thermal_range: ThermalRange | None = None,
    ) -> None:
        colours = painted(num_classes) if palette is None else palette
        common = (root, name, num_classes, classes, colours)
        super().__init__(*common, background=background, unscored=unscored)
        self.codes = label_codes(classes, ids, None, ignored)
        self.follow(rgb, thermal, label, thermal_range)
        frames: list[tuple[int, FrameFiles]] = []
        for frame in find_frames(self.root, self.patterns).values():
            found = re.findall(r"\d+", frame.values[NAME])
            if not found:
                raise InputError(f"the frame {frame.rgb} of a video has no number in its name.")
            frames.append((int(found[-1]), frame))
        self.add(frames, self.patterns[1:], lists, gaps)


class MVSeg(VideoDataset):
    """Reads RGB-thermal videos with few labelled frames, in the layout of the MVSeg archive.

    Layout: {train,val,test,test_day,test_night}.txt, one name of a video per line, and
    data/VIDEO/visible/NNNNNv.jpg, data/VIDEO/infrared/NNNNNi.jpg (or png),
    data/VIDEO/label/NNNNNl.png. The frame number is the last four digits; what is before
    them distinguishes recordings of one video.

    Value 255 of a label is ignored; the authors' code trains and scores it as "ground".

    Source: Ji et al., "Multispectral Video Semantic Segmentation: A Benchmark Dataset and
    Baseline", CVPR 2023.
    """

    # JPEG stores grey images with three channels that may differ by rounding.
    images = PairReader(
        layouts=tuple(layout._replace(label=None) for layout in LAYOUTS), most_tint=8
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
        frames: list[tuple[int, FrameFiles]] = []
        found: dict[str, FrameFiles] = {}
        for layout in LAYOUTS:
            found |= layout.frames(self.root)
        for frame in found.values():
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
        partners = [pattern for layout in LAYOUTS for pattern in layout[1:]]
        self.add(frames, partners, lists, gaps)


def frames_in_order(dataset: LabelledDataset, split: str) -> Sequences:
    """Return the names of all frames of the sequences of a split, labelled or not, in order.

    A frame without a neighbour is in none of them. InputError: no two frames follow each other.
    """
    reader = reader_of(dataset)
    if isinstance(reader, VideoDataset):
        every = reader.sequences(split)
    else:
        every = sequences_of_names(dataset.names(split))
    sequences = tuple(sequence for sequence in every if len(sequence) > 1)
    if not sequences:
        raise InputError(
            f"split '{split}' of {dataset.name} has no two consecutive frames among its "
            f"{len(every)} frame(s); frames=video requires names whose numbers follow each "
            "other, such as 00101D and 00102D."
        )
    return sequences


def frames_before(sequences: Sequences) -> dict[str, str]:
    """Return the frame before each frame but the first ones, by name, in order."""
    before: dict[str, str] = {}
    for sequence in sequences:
        for name, later in pairwise(sequence):
            before[later] = name
    return before


def sequences_of_names(names: Iterable[str]) -> Sequences:
    """Find runs of names that are equal but for their last number, by consecutive numbers.

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
    """Cut frames by number where these are further apart than the smallest step."""
    numbers = sorted(frames)
    steps = [later - number for number, later in pairwise(numbers)]
    usual = min(steps, default=1)
    run: list[str] = []
    for number, after in zip_longest(numbers, steps):
        run.append(frames[number])
        if after != usual:
            yield tuple(run)
            run = []
