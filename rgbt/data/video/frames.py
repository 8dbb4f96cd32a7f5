"""The frames of videos by number, and the sequences without a gap that they form."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Literal, NamedTuple

from rgbt.checks import InputError
from rgbt.data.folder.frames import FolderFrame
from rgbt.data.sequences import consecutive

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


def sequences_of(video: str, frames: Mapping[int, str], gaps: Gaps) -> tuple[tuple[str, ...], ...]:
    """The frames of a video in order.

    The step between two numbers is the smallest one of the video.

    Raises:
        InputError: a number is missing and `gaps` is "refuse".
    """
    runs = tuple(consecutive(dict(frames)))
    if gaps == "refuse" and len(runs) > 1:
        numbers = tuple(frames)
        step = min(later - number for number, later in pairwise(numbers))
        before = next(n for n, later in pairwise(numbers) if later - n != step)
        raise InputError(
            f"video '{video}' lacks frame {before + step}, which should follow "
            f"'{frames[before]}'; restore it, or set dataset.gaps=split to begin another sequence "
            "after each gap."
        )
    return runs
