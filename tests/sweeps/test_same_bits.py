"""A sweep's workers give the bits of the plain command, however many there are."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from rgbt.metrics.counts import Counts
from tests.commands import SPLITS, short, words_of
from tests.conftest import write_data

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
def test_workers_and_cores_do_not_change_counts(tmp_path: Path) -> None:
    """With one thread instead of two, the counts of this experiment are others."""
    data = write_data(tmp_path / "mf", SPLITS, (48, 64))
    environment = {name: value for name, value in os.environ.items() if name != "OMP_NUM_THREADS"}
    one_core = ["taskset", "-c", str(min(os.sched_getaffinity(0)))]

    def counts(name: str, *words: str, before: tuple[str, ...] = ()) -> list[bytes]:
        chosen = ("+experiment=cmx", "masker.patch_size=null", "trainer.threads=2", *short(4))
        typed = words_of(data, tmp_path / name, *chosen, *words)
        command = [*before, sys.executable, "-m", "rgbt.run", *typed]
        subprocess.run(command, check=True, cwd=ROOT, capture_output=True, env=environment)
        found = sorted((tmp_path / name).glob("*/counts_test.npz"))
        return [Counts.load(path).counts.tobytes() for path in found]

    (plain,) = counts("plain", "seed=0")
    assert counts("core", "seed=0", before=tuple(one_core)) == [plain]
    one = counts("one", "-m", "seed=0,1")
    two = counts("two", "-m", "seed=0,1", "hydra.sweeper.workers=2")
    assert len(one) == 2
    assert plain in one
    assert one == two
    assert counts("threads", "seed=0", "trainer.threads=1") != [plain]
