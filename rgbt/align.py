"""Align RGB and thermal images of one rig: ``rgbt align dataset=mine out=aligned``.

It writes images that show the same pixels, their labels, and pictures to judge by. Exit code 1: the
alignment cannot be estimated.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from rgbt.checks import InputError
from rgbt.config.options import Help
from rgbt.config.plain_command import PlainCommand

Rate = Annotated[float, Interval(ge=0.01, le=10_000)]


@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of the command."""

    out: Annotated[Path, Help("folder for the aligned pairs, created if it is missing")]
    matrix: Annotated[
        Path | None,
        Help(
            "file of OpenCV (YAML, JSON): H (RGB to thermal pixels), or K_rgb, D_rgb, K_thermal, "
            "D_thermal, R, t (RGB to thermal camera) and distance (of the plane that is aligned)"
        ),
    ] = None
    points: Annotated[
        Path | None, Help("CSV of clicked points: x and y in RGB, x and y in thermal")
    ] = None
    pairs: Annotated[
        int, Interval(ge=1, le=1000), Help("number of pairs that the homography is estimated from")
    ] = 64
    onto: Annotated[
        Literal["rgb", "thermal"], Help("image whose pixels stay as they are: rgb or thermal")
    ] = "rgb"
    labels: Annotated[
        Literal["rgb", "thermal"], Help("image that the labels were drawn on: rgb or thermal")
    ] = "rgb"
    rgb: Annotated[
        Path | None,
        Help("video file or folder of frames, with thermal: pair them in time for dataset=video"),
    ] = None
    thermal: Annotated[Path | None, Help("video file or folder of frames, with rgb")] = None
    rgb_fps: Annotated[Rate | None, Help("frames per second of rgb; default: of the file")] = None
    thermal_fps: Annotated[Rate | None, Help("frames per second of thermal")] = None
    offset_s: Annotated[
        float | None,
        Help("seconds by which the thermal video began later; default: estimated by motion"),
    ] = None


def main(options: Options, overrides: list[str]) -> int:
    """Write pairs that show the same pixels, by one homography for all of them.

    Overrides choose the data set: dataset=mine, a file of your own. Its RGB and thermal images may
    differ in size. Without matrix or points, the homography is estimated from edges.

    With rgb and thermal, no data set: frames of two videos are paired in time.
    """
    from rgbt.config.overrides import built
    from rgbt.data.file_dataset import FileDataset
    from rgbt.evaluation import alignment, two_videos

    if bool(options.rgb) != bool(options.thermal) or bool(options.rgb) == bool(overrides):
        raise InputError("expected either dataset=... or both rgb=VIDEO and thermal=VIDEO.")
    if options.rgb and options.thermal:
        rates = (
            two_videos.rate_of("rgb", options.rgb, options.rgb_fps),
            two_videos.rate_of("thermal", options.thermal, options.thermal_fps),
        )
        films = options.rgb, options.thermal
        print(two_videos.pair_videos(*films, rates, options.offset_s, options.out))
        return 0
    if options.matrix and options.points:
        raise InputError("expected one of matrix and points.")
    dataset = built("dataset", overrides)
    if not isinstance(dataset, FileDataset):
        raise InputError(f"dataset: {type(dataset).__name__} has no files to align.")
    return alignment.align(
        dataset,
        options.out,
        known=(options.matrix, options.points),
        num_pairs=options.pairs,
        sides=(options.onto, options.labels),
    )


entry = PlainCommand(Options, main, heeds=("dataset",))

if __name__ == "__main__":
    entry()
