"""Sweeps on Ray: a cluster of two nodes with a GPU each, as it believes, and a Ray of its own."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.sweeps import clusters
from tests.sweeps.driven import ROOT, Sweep, check, prune_a_trial, resumed_at, saved_at, steps
from tests.waiting import until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cluster() -> Iterator[Any]:
    with clusters.ray_cluster() as made:
        yield made


@pytest.fixture
def sweep(straight: Sweep, tmp_path: Path, cluster: Any) -> Sweep:
    """Two runs of many steps, one on each node."""
    words = ("hydra/launcher=ray", f"hydra.launcher.address='{cluster.address}'")
    return Sweep(tmp_path / "runs", straight.data, words, varied="seed=0,1")


def test_ray_of_its_own(straight: Sweep, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before the cluster of this module, which would be found."""
    services = pytest.importorskip("ray._private.services", reason="Ray is missing")
    if services.find_gcs_addresses():
        pytest.skip("a Ray runs on this machine")
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    words = ("hydra/launcher=ray", "hydra.launcher.num_cpus=0.5")
    sweep = Sweep(tmp_path / "runs", straight.data, words, steps=400, varied="seed=0", options=())
    refused = sweep.start("hydra.sweeper.wait=false")
    assert sweep.end(refused) == 2
    assert "wait=false" in sweep.text
    process = sweep.start()
    sweep.until_step(3, "0")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGTERM)
    assert sweep.end(process) == 143, sweep.text
    assert saved_at(sweep.log_of("0")) == steps(sweep.folders()["0"])[-1:]
    until(lambda: not services.find_gcs_addresses(), "the end of Ray")


SHARED = """
import json, sys, time
from pathlib import Path
from sweeps.run.job import Work
from sweeps.run.ray_tasks import RayExecutor

folder, address = Path(sys.argv[1]), sys.argv[2]
options = {"address": address, "num_gpus": 0.5, "num_cpus": 0.5, "max_retries": 0}
executor = RayExecutor(options, 5)
works = []
for key in "abcde":
    steps = {("tests.sweeps.steps", "wait", str(folder / key)): None}
    works.append(Work(key, steps, {}, folder / f"{key}.log", folder))
names = executor.submit(works)
assert executor.submit(works) == names, "twice"
def states():
    return sorted(executor.state(name) for name in names)
while states() != ["queued", *["running"] * 4] or len(list(folder.glob("?"))) < 4:
    time.sleep(0.1)
waiting = next(name for name in names if executor.state(name) == "queued")
executor.cancel(waiting)
while states() != [*["running"] * 4] and "queued" in states():
    time.sleep(0.1)
assert not Path(waiting).exists(), "it never starts"
for key in "abcde":
    (folder / f"{key}.go").touch()
while "running" in states():
    time.sleep(0.1)
print(json.dumps({name: executor.state(name) for name in names}))
"""


def test_runs_share_gpus(cluster: Any, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", SHARED, str(tmp_path), cluster.address],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=180,
    )
    assert done.returncode == 0, done.stderr
    found = list(json.loads(done.stdout).values())
    assert found.count("ended") == 4
    assert sum(state.startswith("lost by Ray: ") for state in found) == 1
    told = [json.loads(path.read_text().splitlines()[0]) for path in tmp_path.glob("?")]
    assert [facts["gpus"] for facts in told] == ["0"] * 4, "each node has one of that number"
    nodes = [facts["grandparent"] for facts in told]
    assert sorted(map(nodes.count, set(nodes))) == [2, 2]


def test_jobs_go_on_without_a_driver(sweep: Sweep) -> None:
    sweep.steps = 400
    sweep.finish("hydra.sweeper.wait=false")
    sweep.until_step(3, "0", "1")
    process = sweep.start()
    until(lambda: sweep.text.count("started") == 2, "a driver that has taken over")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGTERM)
    assert sweep.end(process) == 143, sweep.text
    reached = steps(sweep.folders()["0"])[-1]
    sweep.until_step(reached + 2, "0", "1")
    process = sweep.start("hydra.sweeper.stop_jobs=true")
    until(lambda: sweep.text.count("started") == 2, "a driver that has taken over")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    assert sweep.end(process) == 130, sweep.text
    for seed in "01":
        log = sweep.log_of(seed)
        assert (resumed_at(log), saved_at(log)) == ([], steps(sweep.folders()[seed])[-1:])


def test_pruned_trial_saves_and_frees_its_gpu(sweep: Sweep) -> None:
    prune_a_trial(sweep)
    (log,) = (sweep.runs / ".logs").glob("*.log")
    (folder,) = (path.parent for path in sweep.runs.glob("*/run.json"))
    assert saved_at(log.read_text()) == steps(folder)[-1:]


def test_run_of_a_lost_node_is_finished_on_another(
    sweep: Sweep, straight: Sweep, cluster: Any
) -> None:
    process = sweep.start()
    sweep.until_step(5, "0", "1")
    cluster.remove_node(cluster.worker_nodes.copy().pop())
    assert sweep.end(process) == 0, sweep.text
    resumed = [resumed_at(sweep.log_of(seed)) for seed in "01"]
    assert sorted(map(len, resumed)) == [0, 1], "the other one is not touched"
    assert max(resumed)[0] >= 4
    check(sweep, straight, "01")
