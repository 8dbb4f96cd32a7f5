"""The frames of videos by number, and the sequences without a gap that they form."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Literal, NamedTuple

from rgbt.checks import InputError
from rgbt.data.folder.frames import FolderFrame

Gaps = Literal["refuse", "split"]
"""What a missing number in a video means: an error, or the beginning of another sequence."""


class NumberedFrame(NamedTuple):
    """A frame of a video.

    Attributes:
        video: its name; "" where the whole data set is one video.
        number: of the frame.
        files: its images, and where its label is expected.
    """

    video: str
    number: int
    files: FolderFrame


def number_of(name: str, video: str) -> int:
    """The last number in the name of a frame; InputError if there is none."""
    found = re.findall(r"\d+", name)
    if not found:
        of_video = f" of video '{video}'" if video else ""
        raise InputError(
            f"the frame '{name}'{of_video} has no number; name the frames of a video by their "
            "numbers, such as 00012.png."
        )
    return int(found[-1])


def by_video(frames: Iterable[NumberedFrame]) -> dict[str, dict[int, str]]:
    """Video -> number -> name of the frame; InputError if two frames have one number."""
    videos: dict[str, dict[int, str]] = {}
    for frame in frames:
        known = videos.setdefault(frame.video, {})
        if frame.number in known:
            raise InputError(
                f"video '{frame.video}' has two frames with the number {frame.number}, "
                f"'{known[frame.number]}' and '{frame.files.name}'; rename one of them."
            )
        known[frame.number] = frame.files.name
    return {video: dict(sorted(known.items())) for video, known in videos.items()}


def smallest_step(videos: Iterable[Mapping[int, str]]) -> int | None:
    """The smallest step between the numbers of two frames of one video; None without any."""
    steps = [later - number for frames in videos for number, later in pairwise(frames)]
    return min(steps, default=None)


def check_whole(video: str, frames: Mapping[int, str], step: int | None) -> None:
    """Refuse a video in which a number is missing; `step` as of `smallest_step`."""
    for number, later in pairwise(frames):
        if step is not None and later - number != step:
            raise InputError(
                f"video '{video}' lacks frame {number + step}, which should follow "
                f"'{frames[number]}'; restore it, or set dataset.gaps=split to begin another "
                "sequence after each gap."
            )
