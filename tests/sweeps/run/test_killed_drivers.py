"""Drivers that are killed at any instant and started again: every point is trained once."""

from __future__ import annotations

import getpass
import os
import random
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest

from tests.sweeps import clusters
from tests.sweeps.driven import Sweep, check, resumed_at
from tests.waiting import until

pytestmark = pytest.mark.slow


@pytest.fixture
def cluster(request: pytest.FixtureRequest) -> Iterator[tuple[str, ...]]:
    """The words of a launcher whose cluster runs."""
    with ExitStack() as stack:
        if request.param == "submitit_slurm":
            pytest.importorskip("submitit", reason="submitit is missing: pip install -e '.[dev]'")
            stack.enter_context(clusters.slurm())
            yield "hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=4"
            command = ["squeue", "--noheader", f"--user={getpass.getuser()}"]
            until(lambda: not subprocess.check_output(command), "the end of all jobs", 0.2)
        elif request.param == "ray":
            address = stack.enter_context(clusters.ray_cluster()).address
            yield "hydra/launcher=ray", f"hydra.launcher.address='{address}'"
        else:
            yield ("hydra.sweeper.workers=2",)


# Seconds: a driver starts within one or two, four runs take about thirty.
@pytest.mark.parametrize(
    ("cluster", "kills", "longest"),
    [("basic", 10, 4.0), ("submitit_slurm", 10, 4.0), ("ray", 6, 7.0)],
    indirect=["cluster"],
)
def test_driver_killed_again_and_again(
    straight: Sweep, tmp_path: Path, cluster: tuple[str, ...], kills: int, longest: float
) -> None:
    draw, sweep = random.Random(kills), Sweep(tmp_path / "runs", straight.data, cluster)
    for _ in range(kills):
        process = sweep.start()
        assert process.pid is not None
        time.sleep(draw.uniform(0.3, longest))
        is_group = draw.random() < 0.5
        with suppress(ProcessLookupError):  # it has ended, or does not lead its group yet
            (os.killpg if is_group else os.kill)(process.pid, signal.SIGKILL)
        sweep.end(process)
    sweep.finish()
    check(sweep, straight)
    for seed in "0123":
        log = sweep.log_of(seed)
        assert (log.count("steps    16 of"), resumed_at(log)) == (1, []), "it is not disturbed"
