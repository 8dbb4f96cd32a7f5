"""Small videos in MVSeg's layout and in a layout of somebody's own, with known contents."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rgbt.data.video import Video
from rgbt.randomness import numpy_generator
from tests.conftest import write_png

HW = (32, 48)
MVSEG = {"train": ("a", "b"), "val": ("c",), "test": ("d", "n"), "test_night": ("n",)}
FRAMES = (236, 237, 238, 239)
LABELLED = (237, 239)


def contents(name: str, classes: int = 26) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """RGB, thermal and label of a frame."""
    rng = numpy_generator(0, name)
    rgb = rng.integers(0, 256, (*HW, 3), dtype=np.uint8)
    thermal = rng.integers(0, 256, HW, dtype=np.uint8)
    return rgb, thermal, rng.integers(0, classes, HW, dtype=np.uint8)


def write_mvseg(root: Path) -> Path:
    """Five videos of four frames, of which the second and the last are labelled."""
    for split, videos in MVSEG.items():
        for video in videos:
            for number in FRAMES:
                stem, folder = f"{number:05d}", root / "data" / video
                rgb, thermal, label = contents(f"{video}_{stem}")
                write_png(folder / "visible" / f"{stem}v.png", rgb)
                write_png(folder / "infrared" / f"{stem}i.png", np.dstack([thermal] * 3))
                if number in LABELLED:
                    write_png(folder / "label" / f"{stem}l.png", label)
        (root / f"{split}.txt").write_text("\n".join(videos) + "\n")
    return root


def write_videos(root: Path, videos: dict[str, tuple[int, ...]] | None = None) -> Path:
    """Videos x and y of packed images; frame 2 of each is labelled."""
    for video, numbers in (videos or {"x": (1, 2, 3), "y": (8, 9, 10)}).items():
        for number in numbers:
            rgb, thermal, label = contents(f"{video}_{number}", 3)
            write_png(root / video / "rgb" / f"{number}.png", rgb)
            write_png(root / video / "ir" / f"{number}.png", thermal)
            if number == numbers[min(1, len(numbers) - 1)]:
                write_png(root / video / "label" / f"{number}.png", label)
    for split in ("train", "val", "test"):
        (root / f"{split}.txt").write_text("x\ny\n" if split == "test" else "x\n")
    return root


def video(root: Path, **keys: Any) -> Video:
    """The reader of what `write_videos` writes."""
    settings: dict[str, Any] = {
        "num_classes": 3,
        "classes": ("background", "person", "car"),
        "rgb": "{video}/rgb/{name}.png",
        "thermal": "{video}/ir/{name}.png",
        "label": "{video}/label/{name}.png",
        "lists": {split: f"{split}.txt" for split in ("train", "val", "test")},
    }
    return Video(str(root), **(settings | keys))
