"""Sweeps, tables and searches whose runs are jobs of a real SLURM."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.sweeps import clusters
from tests.sweeps.driven import Sweep, check, prune_a_trial, resumed_at, saved_at, steps
from tests.waiting import until

pytestmark = pytest.mark.slow

SLURM = (
    *("hydra/launcher=submitit_slurm", "hydra.launcher.timeout_min=30"),
    "hydra.launcher.cpus_per_task=1",
)


@pytest.fixture(scope="module", autouse=True)
def slurm() -> Iterator[None]:
    pytest.importorskip("submitit", reason="submitit is missing: pip install -e '.[dev]'")
    with clusters.slurm():
        yield


@pytest.fixture
def sweep(straight: Sweep, tmp_path: Path) -> Sweep:
    """Four runs on SLURM; those of `straight` otherwise."""
    return Sweep(tmp_path / "runs", straight.data, SLURM)


@pytest.fixture
def short(straight: Sweep, tmp_path: Path) -> Sweep:
    """Two runs of few steps on SLURM."""
    return Sweep(tmp_path / "runs", straight.data, SLURM, steps=4, varied="seed=0,1")


def queue() -> dict[str, str]:
    """The jobs that SLURM has, and the states of those that have ended."""
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%i %T"]
    text = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return dict(line.split() for line in text.splitlines())


def unfinished() -> list[str]:
    return [job for job, state in queue().items() if state in ("PENDING", "RUNNING", "COMPLETING")]


def test_jobs_that_are_queued_again_give_the_same_runs(sweep: Sweep, straight: Sweep) -> None:
    process = sweep.start()
    until(lambda: len(sweep.jobs()) == 4, "four jobs")
    jobs = sweep.jobs()
    array = jobs["0"].partition("_")[0]
    assert list(jobs.values()) == [f"{array}_{n}" for n in range(4)]
    sweep.until_step(5, "0", "2")
    for seed, names in {"0": ["USR2"], "2": ["TERM", "USR2"]}.items():
        for name in names:  # near the end of its time, and for another job
            subprocess.run(["scancel", f"--signal={name}", jobs[seed]], check=True)
    assert sweep.end(process) == 0, sweep.text
    assert {queue()[job] for job in jobs.values()} == {"COMPLETED"}
    for seed in "0123":
        resumed = resumed_at(sweep.log_of(seed))
        assert [step >= 5 for step in resumed] == ([True] if seed in "02" else [])
    check(sweep, straight)
    assert len(re.findall(r"finished +seed=\d", sweep.text)) == 4


def test_cancelled_job_fails_and_is_resumed(short: Sweep) -> None:
    short.steps = 200
    process = short.start()
    until(lambda: len(short.jobs()) == 2, "two jobs")
    job = short.jobs()["0"]
    short.until_step(3, "0", "1")
    subprocess.run(["scancel", *short.jobs().values()], check=True)
    assert short.end(process) == 1
    assert re.search(rf"failed +seed=0 .*saved.*; job {job}: cancelled", short.text), short.text
    (at,) = saved_at(short.log_of("0"))
    process = short.start("hydra.sweeper.retry=failed", "hydra.sweeper.stop_jobs=true")
    short.until_step(at + 1, "0")
    assert resumed_at(short.log_of("0")) == [at] >= [3]
    assert process.pid is not None
    os.kill(process.pid, signal.SIGINT)
    assert short.end(process) == 130
    until(lambda: not unfinished(), "the end of the jobs")
    assert saved_at(short.log_of("0")) == [at, steps(short.folders()["0"])[-1]], "by stop_jobs=true"


def test_jobs_go_on_without_a_driver(short: Sweep) -> None:
    before = set(queue())
    short.finish("hydra.sweeper.wait=false")
    jobs = short.jobs()
    assert set(queue()) - before == set(jobs.values())
    short.finish("hydra.sweeper.wait=false")
    assert short.jobs() == jobs, "nothing is submitted twice"
    process = short.start()
    until(lambda: len(short.jobs()) == 2, "two jobs")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGTERM)
    assert short.end(process) == 143
    until(lambda: not unfinished(), "the end of the jobs")
    said = short.finish("hydra.sweeper.wait=false")
    assert (short.jobs(), set(queue()) - before) == ({}, set(jobs.values()))
    assert " 2 " in next(line for line in said.splitlines() if line.startswith("  grbm "))
    assert [resumed_at(short.log_of(seed)) for seed in "01"] == [[], []]


def test_one_run_is_a_job_that_outlives_its_command(sweep: Sweep, straight: Sweep) -> None:
    sweep.varied, sweep.options = "seed=0", ()
    before = set(queue())
    process = sweep.start()
    sweep.until_step(3, "0")
    assert process.pid is not None
    os.kill(process.pid, signal.SIGTERM)
    assert sweep.end(process) == 143
    assert "jobs that continue without this command: 1." in sweep.text
    (job,) = set(queue()) - before
    assert re.search(rf"queued +grbm-\w+, job {job}\n", sweep.text), sweep.text
    said = sweep.finish()  # which follows the same job
    assert set(queue()) - before == {job}
    assert re.search(r"finished +grbm-\w+ ", said), said
    check(sweep, straight, "0")
    assert resumed_at(sweep.log_of("0")) == []
    assert f"started on {os.uname().nodename}" in sweep.log_of("0")


def test_pruned_trial_saves_and_frees_its_node(short: Sweep) -> None:
    prune_a_trial(short)
    until(lambda: not unfinished(), "the end of the job")
    (folder,) = (path.parent for path in short.runs.glob("*/run.json"))
    (log,) = (short.runs / ".logs").glob("*.log")
    assert saved_at(log.read_text()) == steps(folder)[-1:]


def test_full_disk_names_its_file_and_is_retried(short: Sweep) -> None:
    """A limit of the size of files stands for it."""
    short.varied = "seed=0"
    process = short.start("hydra.launcher.setup=[ulimit -f 500]")
    assert short.end(process) == 1
    reason = r"last\.pt: File too large \([\d.]+ MB are needed, [\d.]+ MB are free\)"
    assert re.search(rf"failed .*{reason}", short.text), short.text
    assert short.end(short.start()) == 1, "it is known"
    assert short.jobs() == {}
    short.finish("hydra.sweeper.retry=failed")
    assert steps(short.folders()["0"]) == [1, 2, 3, 4]


TABLE = """
paper: my
number: ablation
caption: Rows of a test.
data: noise
columns:
  - {name: mIoU, metric: mIoU}
  - {name: thermal, metric: mIoU, modality: thermal}
rows:
  - {label: one, experiment: baseline}
  - {label: two, experiment: grbm}
"""


def test_table_with_evaluations(short: Sweep, tmp_path: Path) -> None:
    table = tmp_path / "ablation.yaml"
    table.write_text(TABLE)
    words = ("sweeps.reproduce", f"table={table}", f"runs_dir={short.runs}", *SLURM)
    small: Any = ("trainer.max_steps=2", "trainer.eval_every=2", *SMALL_TABLE)
    process = short.call((*words, "dataset=mfnet", f"dataset.root={short.data}", *small))
    assert short.end(process) == 0, short.text
    assert len(set(re.findall(r"job (\d+_\d)\b", short.text))) == 2
    for log in (short.runs / ".logs").glob("*.log"):
        text = log.read_text()
        assert (text.count("rgbt job: started"), text.count("rgbt job: done")) == (1, 1)
    scores = [line for line in short.text.splitlines() if re.match(r" +(one|two) ", line)]
    assert len(scores) == 2


SMALL_TABLE = (
    *("scale.batch_size=2", "scale.eval_batch_size=2", "scale.num_points=64"),
    *("trainer.accelerator=cpu", "trainer.threads=1", "tracking=none"),
)


@pytest.mark.parametrize("options", [("-m",), ()])
def test_processes_of_submitit(straight: Sweep, tmp_path: Path, options: tuple[str, ...]) -> None:
    words = ("hydra/launcher=submitit_local", "hydra.launcher.timeout_min=5")
    sweep = Sweep(tmp_path / "runs", straight.data, words, 4, "seed=0", options)
    sweep.finish()
    assert steps(sweep.folders()["0"]) == [1, 2, 3, 4]
    assert "rgbt job: done" in sweep.log_of("0")
