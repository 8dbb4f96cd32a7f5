"""Jobs of a real SLURM, whose commands only wait: signals, limits, drivers that come and go."""

from __future__ import annotations

import os
import re
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rgbt.checks import RunError
from sweeps.run import submitit_jobs as jobs
from sweeps.run.job import Work, failure_reason
from sweeps.run.submitit_jobs import SubmititExecutor, SubmititJob
from tests.sweeps import clusters
from tests.waiting import until

pytestmark = pytest.mark.slow

ROOT = Path(jobs.__file__).parents[2]
STEPS = "tests.sweeps.steps"


@pytest.fixture(scope="module", autouse=True)
def slurm() -> Iterator[None]:
    pytest.importorskip("submitit", reason="submitit is missing: pip install -e '.[dev]'")
    with clusters.slurm(), pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(ROOT))
        patch.setattr(jobs, "ASK_S", 0.2)
        yield


def slurm_executor(folder: Path, **options: Any) -> SubmititExecutor:
    given = {"submitit_folder": str(folder / ".submitit" / "%j"), "timeout_min": 60}
    return SubmititExecutor("slurm", {**given, "cpus_per_task": 1, **options}, None)


def works(folder: Path, count: int = 1) -> list[Work]:
    """Points whose commands wait for a file "own.go" in their folders."""
    found = []
    for key in "abcd"[:count]:
        place = folder / key
        place.mkdir(exist_ok=True)
        steps = {(STEPS, "train", str(place / "own")): place}
        found.append(Work(key, steps, {}, folder / ".logs" / f"{key}.log", folder))
    return found


def run_folder(work: Work) -> Path:
    return work.folder / work.key


def begun(work: Work) -> int:
    """How often its command has begun."""
    file = run_folder(work) / "steps"
    return len(file.read_text().splitlines()) if file.exists() else 0


def go(*some: Work) -> None:
    for work in some:
        (run_folder(work) / "own.go").touch()


def send(job: str, *signals: str) -> None:
    for name in signals:
        subprocess.run(["scancel", f"--signal={name}", job], check=True)


def restarted(executor: SubmititExecutor, job: str) -> None:
    """Wait until a job has been queued again and has started."""
    until(lambda: executor.state(job) == "queued", "the job to be queued again", 0.1)
    until(lambda: executor.state(job) == "running", "the job to start again", 0.1)


def end(executor: SubmititExecutor, *some: str) -> list[str]:
    """The states of jobs when they have ended."""

    def ended() -> list[str]:
        found = [executor.state(job) for job in some]
        return [] if {"queued", "running"} & set(found) else found

    found: list[str] = until(ended, f"the end of {some}", 0.1)
    return found


def listed(job: str) -> list[str]:
    """The states that SLURM has of all jobs of an array."""
    array = job.partition("_")[0]
    command = ["squeue", "--noheader", "--array", "--states=all", "--format=%T", f"--jobs={array}"]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()


def test_several_points_are_one_array_and_one_is_queued_again(tmp_path: Path) -> None:
    executor, points = slurm_executor(tmp_path), works(tmp_path, 3)
    names = executor.submit(points)
    assert names == [f"{names[0].partition('_')[0]}_{n}" for n in range(3)]
    until(lambda: all(map(begun, points)), "the commands")
    send(names[0], "USR2")  # as before the end of its time
    send(names[2], "TERM")  # as before another job takes its node
    until(lambda: "exit code 143" in points[2].log.read_text(), "the command to save")
    send(names[2], "USR2")
    until(lambda: begun(points[0]) == begun(points[2]) == 2, "both commands again")
    go(*points)
    assert end(executor, *names) == ["ended"] * 3
    assert [begun(work) for work in points] == [2, 1, 2]
    assert listed(names[0]) == ["COMPLETED"] * 3
    assert [failure_reason(work.log, 0) for work in points] == [""] * 3


def test_time_limits_that_a_job_may_reach(tmp_path: Path) -> None:
    """The first one queues it again; after the second one it says why it ends."""
    executor, points = slurm_executor(tmp_path, max_num_timeout=1, timeout_min=5), works(tmp_path)
    (job,) = executor.submit(points)
    until(lambda: begun(points[0]) == 1, "the command")
    send(job, "USR2")
    restarted(executor, job)
    until(lambda: begun(points[0]) == 2, "the command")
    send(job, "USR2")
    (state,) = end(executor, job)
    assert re.fullmatch(r"failed; see .*_log\.err", state)
    assert "timed-out too many times" in Path(state.removeprefix("failed; see ")).read_text()
    reason = failure_reason(points[0].log, 0)
    assert reason == "Job not requeued because: timed-out too many times"


def test_signal_of_the_first_moment_queues_again(tmp_path: Path) -> None:
    """While the command of the job still starts."""
    executor, points = slurm_executor(tmp_path), works(tmp_path)
    (job,) = executor.submit(points)
    until(points[0].log.exists, "the job")
    send(job, "TERM", "USR2")
    restarted(executor, job)
    go(*points)
    assert end(executor, job) == ["ended"]
    assert failure_reason(points[0].log, 0) == ""


def test_cancel_saves_what_runs_and_removes_what_waits(tmp_path: Path) -> None:
    executor, points = slurm_executor(tmp_path, array_parallelism=1), works(tmp_path, 2)
    names = executor.submit(points)
    until(lambda: begun(points[0]), "the first command")
    for job in names:
        executor.cancel(job)
    assert end(executor, *names) == ["ended", "cancelled"]
    assert points[0].log.read_text().endswith("rgbt job: exit code 143\n")
    # A stop that has been obeyed, or that nobody could obey, does not stop the next jobs.
    names = executor.submit(points)
    until(lambda: begun(points[0]) == 2, "the first command again")
    time.sleep(2 * SubmititJob.poll_s)
    go(*points)
    assert end(executor, *names) == ["ended", "ended"]
    assert [failure_reason(work.log, 0) for work in points] == ["", ""]
    assert [begun(work) for work in points] == [2, 1]


def test_next_driver_takes_over_what_is_queued_or_runs(tmp_path: Path) -> None:
    points = works(tmp_path, 3)
    first = slurm_executor(tmp_path, array_parallelism=1)
    names = first.submit(points)
    until(lambda: begun(points[0]), "the first command")
    second = slurm_executor(tmp_path, array_parallelism=1)
    assert second.submit(points) == names
    assert [second.state(job) for job in names] == ["running", "queued", "queued"]
    go(*points)
    end(second, *names)
    assert [begun(work) for work in points] == [1, 1, 1]
    (again,) = slurm_executor(tmp_path).submit(points[:1])
    assert again not in names, "one that has ended is not waited for"
    end(second, again)


def test_next_driver_does_not_wait_for_a_job_that_is_stopped(tmp_path: Path) -> None:
    """The driver before was killed after it had stopped its jobs."""
    points, executor = works(tmp_path), slurm_executor(tmp_path)
    (stopped,) = executor.submit(points)
    until(lambda: begun(points[0]), "the command")
    executor.cancel(stopped)
    (job,) = slurm_executor(tmp_path).submit(points)
    assert job != stopped
    go(*points)
    assert end(executor, job) == ["ended"]
    assert failure_reason(points[0].log, 0) == ""


def test_silent_controller_is_no_end_of_a_job(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    points, executor = works(tmp_path), slurm_executor(tmp_path)
    (job,) = executor.submit(points)
    until(lambda: begun(points[0]), "the command")
    until(lambda: executor.state(job) == "running", "its state")
    broken = tmp_path / "bin"
    broken.mkdir()
    (broken / "squeue").write_text("#!/bin/sh\nexit 1\n")
    (broken / "squeue").chmod(0o755)
    with monkeypatch.context() as patch:
        patch.setenv("PATH", f"{broken}{os.pathsep}{os.environ['PATH']}")
        executor._asked_at = float("-inf")
        assert executor.state(job) == "running"
        with pytest.raises(RunError, match="squeue"):
            slurm_executor(tmp_path).submit(points)
    assert slurm_executor(tmp_path).submit(points) == [job]
    go(*points)
    end(executor, job)
    assert begun(points[0]) == 1


def test_submission_that_slurm_refuses(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="slurm: .*partition"):
        slurm_executor(tmp_path, partition="none").submit(works(tmp_path))
