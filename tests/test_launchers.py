"""Grids of Hydra's own sweeper with the published launchers of submitit, here and on SLURM."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.commands import short, words_of
from tests.sweeps import clusters

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module", params=["submitit_local", "submitit_slurm"])
def launcher(request: pytest.FixtureRequest) -> Iterator[str]:
    """Its name; skipped where it cannot run."""
    pytest.importorskip("hydra_plugins.hydra_submitit_launcher")
    if request.param == "submitit_local":
        yield request.param
        return
    with clusters.slurm():
        yield request.param


def grid(launcher: str, data: Path, runs: Path, *words: str) -> tuple[int, str]:
    """Code and messages of a grid."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "rgbt.run", "-m", "hydra/sweeper=basic"),
            *(f"hydra/launcher={launcher}", "hydra.launcher.timeout_min=5"),
            "hydra.launcher.cpus_per_task=1",
            *words_of(data, runs, *short(2), *words),
        ],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), *sys.path])},
        cwd=data.parent,
        capture_output=True,
        text=True,
    )
    return done.returncode, done.stderr


def test_points_are_trained_in_jobs(launcher: str, data: Path, tmp_path: Path) -> None:
    own = tmp_path / "own"
    (own / "experiment").mkdir(parents=True)
    text = "# @package _global_\ndefaults: [crm, _self_]\nname: mine\n"
    (own / "experiment" / "mine.yaml").write_text(text)
    runs = tmp_path / "runs"
    words = (f"hydra.searchpath=[{own}]", "+experiment=mine", "seed=0,1")
    code, err = grid(launcher, data, runs, *words)
    assert code == 0, err
    results = list(runs.glob("*/result.json"))
    assert len(results) == 2
    jobs = {path.name for path in (runs / ".multirun" / ".submitit").glob("*/*_result.pkl")}
    assert len(jobs) == 2


def test_point_that_fails_in_a_job_fails_the_command(
    launcher: str, data: Path, tmp_path: Path
) -> None:
    runs = tmp_path / "runs"
    code, err = grid(launcher, data, runs, "+experiment=crm", "seed=-1,0")
    messages = [line for line in err.splitlines() if line.startswith("rgbt: ")]
    assert (code, len(messages)) == (2, 1), err
    assert "seed" in messages[0]
    assert "Traceback" not in err
    assert len(list(runs.glob("*/result.json"))) == 1  # the other point was trained
