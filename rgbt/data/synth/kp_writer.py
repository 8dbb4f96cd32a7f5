"""Writes scenes as the CRM release lays out KP: JPEG images by recording, labels in one folder.

images/setXX/VYYY/{visible,lwir}/IZZZZZ.jpg   three channels each, those of lwir equal
labels/setXX_VYYY_IZZZZZ.png                  class ids, 19 for void
{train,val,test}{,_day,_night}.txt            one label file per line
"""

from __future__ import annotations

from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from rgbt.data.kp_layout import is_night as is_night_name
from rgbt.data.kp_layout import sets_of
from rgbt.data.synth.kp_classes import class_ids
from rgbt.data.synth.light import is_night
from rgbt.data.synth.scene import render_scene
from rgbt.data.synth.writer import SynthPlan, write_each, write_png

_FRAMES_PER_VIDEO = 40


def write(plan: SynthPlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists.

    Raises:
        OSError: the files cannot be written.
    """
    by_split = names_of(plan)
    names = [name for split in by_split.values() for name in split]
    (folder / "labels").mkdir()
    for name in names:
        for path in _images(folder, name):
            path.parent.mkdir(parents=True, exist_ok=True)
    write_each(partial(_write_numbered, plan, names, folder), plan.num_scenes)
    _write_lists(by_split, folder)


def names_of(plan: SynthPlan) -> dict[str, list[str]]:
    """Split -> names of its scenes, which are numbered over all splits.

    The recordings are those that the CRM release gives to a split, by day and at night.
    """
    sizes = {"train": plan.num_train, "val": plan.num_val, "test": plan.num_test}
    found: dict[str, list[str]] = {}
    first = 0
    for split, size in sizes.items():
        scenes = range(first, first + size)
        nights = [is_night(plan.seed, scene, plan.factors.night_share) for scene in scenes]
        found[split] = [
            _name(split, night, scene, _place(nights, number))
            for number, (scene, night) in enumerate(zip(scenes, nights, strict=True))
        ]
        first += size
    return found


def _place(nights: list[bool], number: int) -> tuple[int, int]:
    """How many scenes of the same time of day come before this one, and how many there are."""
    return nights[:number].count(nights[number]), nights.count(nights[number])


def _name(split: str, night: bool, scene: int, place: tuple[int, int]) -> str:
    before, total = place
    sets = sets_of(f"{split}_{'night' if night else 'day'}")
    number = before * len(sets) // total
    return f"set{sets[number]:02d}_V{before // _FRAMES_PER_VIDEO:03d}_I{scene:05d}"


def _images(folder: Path, name: str) -> tuple[Path, Path]:
    recording, video, frame = name.split("_")
    place = folder / "images" / recording / video
    return place / "visible" / f"{frame}.jpg", place / "lwir" / f"{frame}.jpg"


def _write_numbered(plan: SynthPlan, names: list[str], folder: Path, number: int) -> None:
    cv2.setNumThreads(1)
    scene = render_scene(plan.seed, number, plan.factors)
    visible, lwir = _images(folder, names[number])
    # OpenCV stores blue first.
    _write_jpeg(visible, np.ascontiguousarray(scene.rgb[..., ::-1]))
    _write_jpeg(lwir, np.repeat(scene.thermal[..., None], 3, axis=2))
    write_png(folder / "labels" / f"{names[number]}.png", class_ids(scene))


def _write_jpeg(path: Path, image: NDArray[np.uint8]) -> None:
    _, encoded = cv2.imencode(".jpg", image)
    path.write_bytes(encoded.tobytes())


def _write_lists(by_split: dict[str, list[str]], folder: Path) -> None:
    for split, names in by_split.items():
        nights = [name for name in names if is_night_name(name)]
        days = [name for name in names if not is_night_name(name)]
        for suffix, listed in (("", names), ("_day", days), ("_night", nights)):
            text = "".join(f"{name}.png\n" for name in sorted(listed))
            if text:
                (folder / f"{split}{suffix}.txt").write_text(text, encoding="utf-8")
