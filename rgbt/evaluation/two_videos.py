"""Pair the frames of two videos in time, and write them as numbered images for dataset=video."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.checks import InputError, RunError
from rgbt.data.files import decode, read_rgb
from rgbt.data.images import PairReader
from rgbt.data.new_images import KINDS
from rgbt.data.patterns import in_order
from rgbt.evaluation.images import write_png
from rgbt.geometry.optical_flow import gray_of
from rgbt.geometry.time_offset import motion, offset_of, paired, small

# First bytes of MP4, AVI and Matroska, at an offset. Other files that a decoder would open, such as
# playlists, name further files.
CONTAINERS = ((4, b"ftyp"), (0, b"RIFF"), (0, b"\x1aE\xdf\xa3"))

Frame = NDArray[Any]


# Channels of a compressed grey video differ by a few levels; those of a palette by far more.
THERMAL = PairReader(layouts=(), thermal_range=(0.0, 1.0), most_tint=8)


def frames_of(setting: str, path: Path) -> Iterator[Frame]:
    """Yield frames in order of a video file or a folder of images, setting "rgb" or "thermal".

    (H, W, 3) R, G, B, of folders of thermal images also (H, W). InputError: unreadable, or RGB
    images of other channels.
    """
    if path.is_dir():
        files = [file for file in path.iterdir() if file.suffix.lower() in KINDS]
        files.sort(key=lambda file: in_order(file.name))
        yield from (read_rgb(file) if setting == "rgb" else decode(file) for file in files)
        return
    video = cv2.VideoCapture(str(path))
    try:
        while (read := video.read())[0]:
            yield read[1][..., ::-1]
    finally:
        video.release()


def rate_of(setting: str, path: Path, rate_hz: float | None) -> float:
    """Return `rate_hz`, or that of a video file; InputError: no video, or no rate."""
    if path.is_dir():
        if rate_hz is None:
            raise InputError(f"{setting}_fps has no value; a folder of images has no frame rate.")
        return rate_hz
    if not path.is_file():
        raise InputError(f"{setting}={path}: there is no such video file or folder of images.")
    with path.open("rb") as file:
        head = file.read(16)
    if not any(head[at:].startswith(word) for at, word in CONTAINERS):
        raise InputError(f"{setting}={path}: expected a video in MP4, MOV, AVI, MKV or WebM.")
    video = cv2.VideoCapture(str(path))
    rate = rate_hz or float(video.get(cv2.CAP_PROP_FPS))
    video.release()
    if not 0 < rate < 10_000:
        raise InputError(f"{setting}_fps has no value, and {path} names no frame rate.")
    return rate


def pair_videos(
    rgb: Path, thermal: Path, rates_hz: tuple[float, float], offset_s: float | None, out: Path
) -> str:
    """Write out/rgb/NUMBER.png and out/thermal/NUMBER.png of frames of one time; what was done.

    `offset_s`: how much later the thermal video began; None: estimated by motion.

    Raises:
        InputError: a video cannot be read, thermal has colours, or no two frames are of one time.
        RunError: the offset cannot be estimated.
    """
    films = {"rgb": rgb, "thermal": thermal}
    thumbnails = []
    for setting, path in films.items():
        levels = gray_of if setting == "rgb" else partial(THERMAL.check_values, path=path)
        frames = [small(levels(frame)) for frame in frames_of(setting, path)]
        if len(frames) < 2:
            raise InputError(f"{setting}={path}: {len(frames)} frames can be read.")
        thumbnails.append(frames)
    how = "given"
    if offset_s is None:
        first, second = (motion(frames) for frames in thumbnails)
        offset_s, how = offset_of(first, second, rates_hz), "estimated by motion"
    if offset_s is None:
        raise RunError(
            "the offset cannot be estimated from the motion of both videos: too short, still, or "
            "of even motion. Give offset_s=SECONDS, how much later the thermal video began."
        )
    first_length, second_length = map(len, thumbnails)
    pairs = paired((first_length, second_length), rates_hz, offset_s)
    if not pairs:
        raise InputError(f"offset_s={offset_s:g}: no two frames are of one time.")
    for side, (setting, path) in enumerate(films.items()):
        numbers: dict[int, list[int]] = {}
        for number, pair in enumerate(pairs):
            numbers.setdefault(pair[side], []).append(number)
        for index, frame in enumerate(frames_of(setting, path)):
            for number in numbers.get(index, ()):
                image = THERMAL.check_values(frame, path) if side else frame[..., ::-1]
                write_png(out / setting / f"{number:06d}.png", np.ascontiguousarray(image))
    return (
        f"{len(pairs)} pairs of {first_length} RGB frames ({rates_hz[0]:g}/s) and {second_length} "
        f"thermal frames ({rates_hz[1]:g}/s); thermal began {offset_s:.2f} s later ({how})"
    )
