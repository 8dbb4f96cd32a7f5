"""Synthetic scenes per second on one thread: rendered only, and rendered and written as PNG.

Run: python -m tests.benchmarks.bench_synth [num_scenes]
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from rgbt.synth.datasets import MFNET_LAYOUT
from rgbt.synth.export import Plan, shots_of, write_shot
from rgbt.synth.factors import SceneFactors
from rgbt.synth.scene import render_scene
from tests.benchmarks.timing import in_turns

WANTED = 100.0
"""Scenes per second and core at 120 x 160, rendered only (issue: dataset synth)."""

ROUNDS = 5


def rate(work: Callable[[int], object], num_scenes: int) -> tuple[float, float]:
    """Scenes per CPU second: median round, and each scene at the best of all rounds."""
    each = {str(index): partial(work, index) for index in range(num_scenes)}
    cpu = np.stack([timed[:, 0] for timed in in_turns(each, ROUNDS, warm=False).values()], 1)
    return num_scenes / float(np.median(cpu.sum(1))), num_scenes / float(cpu.min(0).sum())


def main(num_scenes: int) -> None:
    cv2.setNumThreads(1)
    factors = SceneFactors()
    for index in range(20):
        render_scene(0, index, factors)
    plan = Plan(name="x", seed=0, numbers={"train": num_scenes}, factors=factors)
    shots = shots_of(MFNET_LAYOUT, plan)
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        rows = {
            "render": rate(lambda index: render_scene(0, index, factors), num_scenes),
            "render + PNG": rate(
                lambda index: write_shot(MFNET_LAYOUT, plan, folder, shots[index]), num_scenes
            ),
        }
    print(f"{factors.height} x {factors.width}, one thread, {num_scenes} scenes, CPU time")
    print(f"{'':<14}{'median':>10}{'best':>10}   scenes/s")
    for name, (median, best) in rows.items():
        print(f"{name:<14}{median:>10.0f}{best:>10.0f}")
    print(f"wanted: {WANTED:.0f} rendered scenes/s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
