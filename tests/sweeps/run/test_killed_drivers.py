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


# Seconds: a driver starts within one or two, with Ray in four; its runs take about fifteen.
@pytest.mark.parametrize(
    ("cluster", "kills", "longest"),
    [("basic", 10, 3.0), ("submitit_slurm", 10, 3.0), ("ray", 5, 6.0)],
    indirect=["cluster"],
)
def test_driver_killed_again_and_again(
    straight: Sweep, tmp_path: Path, cluster: tuple[str, ...], kills: int, longest: float
) -> None:
    draw = random.Random(kills)
    sweep = Sweep(tmp_path / "runs", straight.data, cluster, varied="seed=0,1,2")
    for _ in range(kills):
        process = sweep.start()
        assert process.pid is not None
        time.sleep(draw.uniform(0.3, longest))
        is_group = draw.random() < 0.5
        with suppress(ProcessLookupError):  # it has ended, or does not lead its group yet
            (os.killpg if is_group else os.kill)(process.pid, signal.SIGKILL)
        sweep.end(process)
    sweep.finish()
    check(sweep, straight, "012")
    for seed in "012":
        log = sweep.log_of(seed)
        # A driver that ends between a submission and its note leaves a second job, which the lock
        # of the run refuses after its header.
        assert (log.count("\n 1/10 "), resumed_at(log)) == (1, []), "it is trained once"
