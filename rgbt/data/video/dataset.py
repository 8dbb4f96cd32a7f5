"""Read any folder of numbered RGB-thermal frames: one video, or several in folders."""

from __future__ import annotations

import os
from collections.abc import Collection, Iterable, Iterator, Sequence
from pathlib import Path

from rgbt.checks import InputError
from rgbt.data.file_dataset import FileDataset, SplitNames
from rgbt.data.folder.frames import (
    FolderFrame,
    Patterns,
    find_frames,
    without_rgb,
)
from rgbt.data.folder.pattern import NAME, Pattern, what_is_in
from rgbt.data.folder.splits import ByList
from rgbt.data.images import PairPattern, Range
from rgbt.data.labels import LabelValue, label_codes, painted
from rgbt.data.named_files import existing_root, hash_of_files
from rgbt.data.sequences import consecutive
from rgbt.data.video.frames import (
    Gaps,
    NumberedFrame,
    by_video,
    check_whole,
    number_of,
    smallest_step,
)
from rgbt.ranges import Colour, Names, NumClasses, Text

VIDEO = "video"
"""The word of the patterns that names a video."""

ALL = "all videos"
"""What a split without a list is, for messages."""


class VideoDataset(FileDataset):
    """Base of data sets of videos; a subclass finds the frames.

    `names` of a split are its labelled frames, for training and evaluation; all frames where the
    split has no label. `sequences` are all frames, for temporal consistency.

    Args:
        root: its folder.
        name: see `FileDataset`, as `num_classes`, `classes`, `palette`, `background` and
            `unscored`.
        lists: split -> list of names of videos in `root`; None: the split "test" is all videos.
        gaps: what a missing number in a video means.

    Attributes:
        frames: name -> frame.
        videos: name of a video -> number -> name of the frame.
    """

    splits_key = "dataset.lists"

    def __init__(  # noqa: PLR0913 - settings of every data set of videos
        self,
        root: Path,
        name: str,
        num_classes: int,
        classes: tuple[str, ...],
        palette: tuple[tuple[int, int, int], ...],
        *,
        lists: dict[str, str] | None,
        gaps: Gaps,
        background: tuple[str, ...],
        unscored: tuple[str, ...] = (),
    ) -> None:
        super().__init__(
            *(root, name, num_classes, classes, palette),
            background=background,
            unscored=unscored,
        )
        self._lists = None if lists is None else ByList(root, dict(lists))
        self.gaps = gaps
        self.frames: dict[str, NumberedFrame] = {}
        self.videos: dict[str, dict[int, str]] = {}

    def add(self, frames: Iterable[NumberedFrame], partners: Sequence[Pattern | None]) -> None:
        """Use these frames, which have thermal images and labels of the patterns `partners`.

        InputError if two have one number.
        """
        self._partners = partners
        self.frames = {
            frame.files.name: frame._replace(files=_with_existing_label(frame.files))
            for frame in frames
        }
        self.videos = by_video(self.frames.values())

    @property
    def splits(self) -> dict[str, str]:
        """Split -> its list."""
        return {"test": ALL} if self._lists is None else self._lists.splits

    def videos_of(self, split: str) -> tuple[str, ...]:
        """Names of the videos of a split; InputError if one of them is not there, or empty."""
        self.check_split(split)
        if self._lists is None:
            return tuple(self.videos)
        names = self._lists.names(split)
        for name in names:
            if name not in self.videos:
                raise InputError(
                    f"dataset.lists.{split}: video '{name}' has no frames in {self.root}; add them "
                    f"as {self.images.layouts[0]}, or remove the name from the list."
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
            InputError: a video of the list is empty, or it lacks a number, an RGB image or a
                thermal image.
        """
        videos = self.videos_of(split)
        if self.gaps == "refuse":
            step = smallest_step(self.videos.values())
            for video in videos:
                check_whole(video, self.videos[video], step)
            problems = self._unpaired(videos)
            if problems:
                raise InputError(
                    f"{problems[0]}; restore it, or set dataset.gaps=split and remove the rest of "
                    "that frame."
                )
        return tuple(run for video in videos for run in consecutive(self.videos[video]))

    def has(self, split: str) -> bool:
        """Whether the list of `split` exists; InputError if the split is unknown."""
        self.check_split(split)
        return self._lists is None or self._lists.has(split)

    def names(self, split: str) -> tuple[str, ...]:
        """Labelled frames of a split, video by video; all frames where none is labelled."""
        if split not in self._names:
            every = self.all_names(split)
            labelled = tuple(name for name in every if self.frame(name).label is not None)
            self._names[split] = labelled or every
        return self._names[split]

    def frame(self, name: str) -> FolderFrame:
        """The files of `name`; no label where there was none when the folder was listed."""
        if name not in self.frames:
            raise InputError(
                f"{self.name} ({self.root}) has no frame called '{name}'; restore its RGB image."
            )
        return self.frames[name].files

    def nights(self, names: tuple[str, ...]) -> tuple[bool, ...] | None:
        """Whether the video of each name is in a list of a split "..._night", or "..._day".

        A video in neither list is a day video where its split has a list of the night alone. None
        if a video is in no list at all.
        """
        if self._lists is None:
            return None
        present = [split for split in self.splits if self._lists.has(split)]
        at_night, by_day = set[str](), set[str]()
        for split in present:
            whole, _, part = split.rpartition("_")
            if part == "night":
                at_night |= set(self._lists.names(split))
                by_day |= set(self._lists.names(whole) if whole in present else ())
            elif part == "day":
                by_day |= set(self._lists.names(split))
        videos = [self.frames[name].video for name in names]
        if not set(videos) <= at_night | by_day:
            return None
        return tuple(video in at_night for video in videos)

    def fingerprint(self) -> str:
        """See `hash_of_files`; of all frames, labelled or not."""
        listed = {split: self.all_names(split) if self.has(split) else () for split in self.splits}
        return hash_of_files(listed, self.files)

    def unused(self, lists: SplitNames) -> Iterable[Path]:  # noqa: ARG002 - as every data set
        """None: frames without a label belong to a video, for the rest see `own_problems`."""
        return ()

    def own_problems(self, lists: SplitNames) -> list[str]:
        """Frames without an RGB image, or without a thermal image, of any split."""
        return [f"{each}." for each in self._unpaired(None, set().union(*lists.values()))]

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

    def own_notes(self, lists: SplitNames) -> list[str]:
        """Numbers of videos and frames of each split."""
        return [
            f"split {split}: {len(self.videos_of(split))} videos, "
            f"{len(self.all_names(split))} frames."
            for split in lists
        ]


class Video(VideoDataset):
    """Numbered RGB-thermal frames in any folder whose paths follow patterns.

    A pattern is a path below the root with words in braces (`rgbt.data.folder.pattern`): {name} is
    the frame, whose last number counts, and {video} its video, if there are several. The name of a
    sample is that of its video and that of its frame, joined by "_".

    Args:
        root: folder that the patterns are relative to.
        num_classes: see `FileDataset`, as `classes`, `name` and `palette`.
        classes: see there.
        rgb: pattern of the RGB images, 8 bit, three channels.
        thermal: pattern of the thermal images, one channel or three equal ones, of the size of the
            RGB image; the same as `rgb` for files of four channels R, G, B, thermal.
        label: pattern of the labels, which some frames may lack; None: there are none.
        name: see there.
        palette: None: colours that differ.
        unscored: classes that are counted but left out of every mean over classes.
        background: classes that are no object, see `rgbt.dataset.LabelledDataset`.
        lists: split -> list of names of videos; None: the split "test" is all videos.
        gaps: a missing number in a video is refused, or begins another sequence ("split").
        ids: label value -> class; None: values are class indices.
        ignored: label values that do not count.
        thermal_range: (low, high) thermal values that become black and white; None: 8 bit.

    Raises:
        InputError: no such root, patterns that match nothing, an empty video, frames without
            numbers or in another case, or invalid settings.
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
        folder = existing_root(root, f"that dataset.rgb='{rgb}' starts from")
        colours = painted(num_classes) if palette is None else palette
        super().__init__(
            *(folder, name, num_classes, classes, colours),
            lists=lists,
            gaps=gaps,
            background=background,
            unscored=unscored,
        )
        self.codes = label_codes(classes, ids, None, ignored)
        self.follow(PairPattern(rgb, thermal, label), thermal_range)
        _check_no_empty_video(self.patterns.rgb, folder)
        _check_case(self.patterns.rgb, folder)
        self.add(_numbered(folder, self.patterns), self.patterns[1:])


def _with_existing_label(files: FolderFrame) -> FolderFrame:
    # A broken link is kept; reading it says where it leads.
    exists = files.label is not None and os.path.lexists(files.label)
    return files if exists else files._replace(label=None)


def _numbered(root: Path, patterns: Patterns) -> Iterator[NumberedFrame]:
    for frame in find_frames(root, patterns).values():
        video = frame.values.get(VIDEO, "")
        yield NumberedFrame(video, number_of(frame.values[NAME], video), frame)


def _check_case(rgb: Pattern, root: Path) -> None:
    """Refuse frames that differ from the pattern in upper and lower case alone.

    They would be missing from their video, at its end even without a gap.
    """
    read = {match.path for match in rgb.files(root)}
    for match in rgb.files(root, any_case=True):
        if match.path not in read:
            raise InputError(
                f"{match.path} differs from dataset.rgb='{rgb.text}' in upper and lower case, so "
                "it would not be read; rename it."
            )


def _check_no_empty_video(rgb: Pattern, root: Path) -> None:
    """Refuse a folder of a video that holds no RGB image."""
    above = rgb.text.rpartition("/")[0]
    if f"{{{VIDEO}}}" not in above:
        return
    for match in Pattern(above, rgb.key).files(root):
        if match.path.is_dir() and next(rgb.files(root, match.values), None) is None:
            raise InputError(
                f"video '{match.values[VIDEO]}' is empty: {match.path} holds "
                f"{what_is_in(match.path)}, but dataset.rgb is '{rgb.text}'; add its frames, or "
                "remove the folder."
            )
