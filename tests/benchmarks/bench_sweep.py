"""Wall seconds of a grid: our sweeper with two workers, beside half of what Hydra's own one needs.

Hydra's basic sweeper trains the points one after another in one process, so that it starts nothing:
the ratio is what a process for each point, the run folders and the driver cost. On two free cores.

Run: python -m tests.benchmarks.bench_sweep [points]
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

POINTS = 200
WORDS = ("+experiment=grbm", "+debug=smoke", "tracking=none", "trainer.threads=1")


def seconds(points: int, *more: str) -> float:
    """Wall seconds of a grid over that many seeds."""
    with TemporaryDirectory() as runs:
        seeds = ",".join(map(str, range(points)))
        words = ("-m", "rgbt.run", "-m", *WORDS, f"seed={seeds}", f"runs_dir={runs}", *more)
        began = time.perf_counter()
        subprocess.run([sys.executable, *words], check=True, capture_output=True)
        assert len(list(Path(runs).glob("*/result.json"))) == points
        return time.perf_counter() - began


def main() -> None:
    points = int(sys.argv[1]) if sys.argv[1:] else POINTS
    os.environ["OMP_NUM_THREADS"] = "1"
    basic = seconds(points, "hydra/sweeper=basic")
    ours = seconds(points, "hydra.sweeper.workers=2")
    print(f"{points} points: Hydra basic {basic:.0f} s, ours with two workers {ours:.0f} s,")
    print(f"ratio to half of it {2 * ours / basic:.2f}")


if __name__ == "__main__":
    main()
