"""Writes scenes in MFNet's layout: images, labels, split lists; in parallel where it is worth it.

images/00012D.png   four channels R, G, B, thermal       labels/00012D.png   class ids
train.txt val.txt test.txt test_day.txt test_night.txt   one name per line
next/               the same names after the ego-motion, with flow/NAME.npy, if requested
"""

from __future__ import annotations

import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from rgbt.data.synth.factors import EgoMotion, SceneFactors
from rgbt.data.synth.light import is_night
from rgbt.data.synth.scene import Scene, render_pair, render_scene

_WORTH_A_POOL = 200
"""Scenes; fewer are written before a pool has started."""

_WORTH_A_BAR = 100
"""Scenes; about a second's work."""

_FAST_PNG = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]
"""A third of the time of the quickest ordinary compression, and smaller: the images are noisy."""


@dataclass(frozen=True, kw_only=True)
class SynthPlan:
    """What a written data set consists of; equal plans give equal files.

    Attributes:
        seed: of the data set.
        num_train: scenes of the training split.
        num_val: scenes of the validation split.
        num_test: scenes of the test split.
        factors: what the scenes are made of.
        motion: of the camera to a second frame of every scene, or None for single frames.
    """

    seed: int
    num_train: int
    num_val: int
    num_test: int
    factors: SceneFactors
    motion: EgoMotion | None = None

    @property
    def num_scenes(self) -> int:
        """Scenes in all splits."""
        return self.num_train + self.num_val + self.num_test

    @property
    def splits(self) -> dict[str, range]:
        """Split -> its scenes, which are numbered over all splits: none is in two of them."""
        val, test = self.num_train, self.num_train + self.num_val
        return {"train": range(val), "val": range(val, test), "test": range(test, self.num_scenes)}

    def name(self, index: int) -> str:
        """Five digits and D (day) or N (night), as in MFNet; indices run on over the splits."""
        night = is_night(self.seed, index, self.factors.night_share)
        return f"{index:05d}{'N' if night else 'D'}"


def write(plan: SynthPlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists; OSError if that is not possible."""
    write_each(partial(write_index, plan, folder), plan.num_scenes)
    lists = {split: [plan.name(scene) for scene in own] for split, own in plan.splits.items()}
    for time in ("day", "night"):
        letter = time[0].upper()
        lists[f"test_{time}"] = [name for name in lists["test"] if name.endswith(letter)]
    for root in [folder, folder / "next"] if plan.motion else [folder]:
        for split, names in lists.items():
            write_list(root / f"{split}.txt", names)


def write_list(path: Path, lines: Sequence[str]) -> None:
    """Write a split list, one name per line."""
    path.write_text("".join(f"{line}\n" for line in lines), encoding="utf-8")


def write_index(plan: SynthPlan, folder: Path, index: int) -> None:
    """Render and write one scene, with its second frame where the plan has a motion."""
    name = plan.name(index)
    if plan.motion is None:
        _write_scene(render_scene(plan.seed, index, plan.factors), folder, name)
        return
    pair = render_pair(plan.seed, index, plan.factors, plan.motion)
    _write_scene(pair.first, folder, name)
    _write_scene(pair.second, folder / "next", name)
    flow = np.where(pair.visible[..., None], pair.flow, np.float32(np.nan))
    path = folder / "next" / "flow" / f"{name}.npy"
    path.parent.mkdir(exist_ok=True)
    np.save(path, flow)


def _write_scene(scene: Scene, root: Path, name: str) -> None:
    # The fourth channel, alpha, is thermal.
    write_image(root / "images" / f"{name}.png", np.dstack([bgr(scene), scene.thermal]))
    write_image(root / "labels" / f"{name}.png", scene.label)


def bgr(scene: Scene) -> NDArray[np.uint8]:
    """RGB of a scene in the order in which OpenCV stores channels."""
    return np.ascontiguousarray(scene.rgb[..., ::-1])


def write_image(path: Path, image: NDArray[np.uint8] | NDArray[np.uint16]) -> None:
    """Write an image as it is (OpenCV's order of channels), a PNG compressed for speed."""
    _, encoded = cv2.imencode(path.suffix, image, _FAST_PNG if path.suffix == ".png" else ())
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded.tobytes())


def write_each(work: partial[None], num: int) -> None:
    """``work(index)`` for every scene, on all cores where there are many, with a progress bar."""
    with _advancing(num) as advance:
        for _ in _for_each(work, range(num)):
            advance()


def _for_each(work: partial[None], indices: Sequence[int]) -> Iterator[None]:
    cores = len(os.sched_getaffinity(0)) if sys.platform == "linux" else os.cpu_count() or 1
    if len(indices) < _WORTH_A_POOL or cores == 1:
        cv2.setNumThreads(1)
        yield from map(work, indices)
        return
    # Forked workers need not import the caller's main module again; only Linux forks safely.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(cores, context, cv2.setNumThreads, (1,)) as pool:
        yield from pool.map(work, indices, chunksize=8)


@contextmanager
def _advancing(total: int) -> Iterator[partial[None]]:
    """A progress bar on stderr, gone when done; none for what takes less than about a second."""
    hidden = total < _WORTH_A_BAR
    with Progress(console=Console(stderr=True), transient=True, disable=hidden) as progress:
        task = progress.add_task("writing synthetic scenes", total=total)
        yield partial(progress.advance, task)
