"""Write scenes in a layout of `rgbt.synth.datasets`, once, with several processes if many."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.progress import Progress

from rgbt.checks import InputError
from rgbt.cores import usable_cores
from rgbt.files.atomic import cache_folder
from rgbt.synth.factors import EgoMotion, SceneFactors
from rgbt.synth.light import is_night
from rgbt.synth.scene import Scene, render_pair, render_scene

# Version of the files. Raise it with every change of a byte, so that no cache is stale.
VERSION = 3

# Numbers of scenes: fewer are written before a pool has started, or in less than a second.
_WORTH_A_POOL, _WORTH_A_BAR = 200, 100

# A third of the time of the quickest ordinary compression, and smaller: the images are noisy.
_FAST_PNG = [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE]

# Path in the data set -> image in OpenCV's order of channels, or array if the path says .npy.
Images = dict[str, NDArray[Any]]

# Folder of the second frames, in the same layout, with flow/NAME.npy.
FRAMES = "next"


@dataclass(frozen=True, kw_only=True)
class ScenePlan:
    """Describes a data set: scenes by split, motion to a second frame; equal plans, equal files."""

    name: str
    seed: int
    numbers: Mapping[str, int]
    factors: SceneFactors
    motion: EgoMotion | None = None


class Shot(NamedTuple):
    """Names one scene to be written: number, number in its split (`place` of `total`), names."""

    scene: int
    split: str
    place: int
    total: int
    night: bool
    name: str = ""
    folder: str = ""


class Layout(NamedTuple):
    """Says which files a data set has.

    The shots of a split with their names and folders, the files of a scene, and the split lists
    that a shot is in, if there are any, with its line.
    """

    named: Callable[[list[Shot]], list[Shot]]
    images: Callable[[Scene, Shot], Images]
    lists: Callable[[Shot], dict[str, str]] | None = None


def shots_of(layout: Layout, plan: ScenePlan) -> list[Shot]:
    """Return every scene of a data set, in the order of their numbers; none is in two splits."""
    shots: list[Shot] = []
    for split, total in plan.numbers.items():
        first, plain = len(shots), []
        for place in range(total):
            night = is_night(plan.seed, first + place, plan.factors.night_share)
            plain.append(Shot(first + place, split, place, total, night))
        shots += layout.named(plain)
    return shots


def exported(layout: Layout, plan: ScenePlan, cache_dir: str | Path | None) -> Path:
    """Return the folder of a data set, written now if it is not there yet.

    It is renamed when complete, so that an interrupted generation leaves nothing and two cannot
    mix. `cache_dir` None: $XDG_CACHE_HOME/rgbt or ~/.cache/rgbt; InputError if that is impossible.
    """
    text = json.dumps({"version": VERSION, **asdict(plan)}, sort_keys=True, indent=1)
    cache = Path(cache_dir).expanduser() if cache_dir else cache_folder()
    name = plan.name.replace("/", "_")  # of a stored run: no folder outside the cache
    folder = cache / f"{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}"
    if folder.is_dir():
        return folder
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(prefix=".synth-", dir=cache) as scratch:
            made = Path(scratch) / "made"
            made.mkdir()
            write(layout, plan, made)
            (made / "plan.json").write_text(text + "\n", encoding="utf-8")
            made.rename(folder)
    except OSError as error:
        # Where another process was first, its folder is as good: equal plans give equal files.
        if not folder.is_dir():
            reason = error.strerror or error
            raise InputError(f"dataset.cache_dir: cannot write {folder} ({reason}).") from error
    return folder


def write(layout: Layout, plan: ScenePlan, folder: Path) -> None:
    """Write the whole data set into `folder`, which exists; OSError if that is impossible."""
    shots = shots_of(layout, plan)
    work = partial(write_shot, layout, plan, folder)
    bar = Progress(console=Console(stderr=True), transient=True, disable=len(shots) < _WORTH_A_BAR)
    with bar:
        list(bar.track(_for_each(work, shots), len(shots), description="writing synthetic scenes"))
    lists: dict[str, list[str]] = {}
    for shot in shots:
        for path, line in layout.lists(shot).items() if layout.lists else ():
            lists.setdefault(path, []).append(f"{line}\n")
    for root in [folder, folder / FRAMES] if plan.motion else [folder]:
        for path, lines in lists.items():
            (root / path).write_text("".join(sorted(lines)), encoding="utf-8")


def write_shot(layout: Layout, plan: ScenePlan, folder: Path, shot: Shot) -> None:
    """Render and write one scene, with its second frame where the plan has a motion."""
    factors = replace(plan.factors, night_share=float(shot.night))
    if plan.motion is None:
        _write(layout.images(render_scene(plan.seed, shot.scene, factors), shot), folder)
        return
    pair = render_pair(plan.seed, shot.scene, factors, plan.motion)
    _write(layout.images(pair.first, shot), folder)
    flow = np.where(pair.visible[..., None], pair.flow, np.float32(np.nan))
    second = layout.images(pair.second, shot) | {f"flow/{shot.name}.npy": flow}
    _write(second, folder / FRAMES)


def _write(images: Images, folder: Path) -> None:
    for name, image in images.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.suffix == ".npy":
            np.save(path, image)
            continue
        _, encoded = cv2.imencode(path.suffix, image, _FAST_PNG if path.suffix == ".png" else ())
        path.write_bytes(encoded.tobytes())


def _for_each(work: partial[None], shots: Sequence[Shot]) -> Iterator[None]:
    cores = usable_cores()
    if len(shots) < _WORTH_A_POOL or cores == 1:
        cv2.setNumThreads(1)
        yield from map(work, shots)
        return
    # Forked workers need not import the caller's main module again; only Linux forks safely.
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    with ProcessPoolExecutor(cores, context, cv2.setNumThreads, (1,)) as pool:
        yield from pool.map(work, shots, chunksize=8)
